"""The command `doctor`: what is installed, and what to do for what is missing."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from itertools import groupby

from gscompleter.config.settings import Settings
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(Settings):
    """Print what is installed, and for what is missing its purpose and what to do."""

    json: bool = False
    """Print the result as JSON."""


def run_doctor(options: DoctorOptions) -> None:
    """Inspect the installation and print the result."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.installation import inspect_installation

    parts = list(inspect_installation())
    if options.json:
        print(json.dumps([asdict(part) for part in parts], indent=2))
        return
    width = max(len(part.name) for part in parts)
    for kind, parts_of_kind in groupby(parts, lambda part: part.kind):
        print(f"{kind}:")
        for part in parts_of_kind:
            print(f"  {part.name:{width}}  {'' if part.there else 'missing: '}{part.told}")
