"""The command `doctor`: what is installed, and what to do for what is missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import TYPE_CHECKING

from gscompleter.apps.command_line.exit_codes import DONE, ERROR
from gscompleter.config.settings import Settings
from gscompleter.system.process import import_without_collection

if TYPE_CHECKING:
    from gscompleter.apps.installation import Found


@dataclass(frozen=True, kw_only=True)
class DoctorOptions(Settings):
    """Print what is installed, and for what is missing its purpose and what installs it.

    Example: gscompleter doctor --needs poses film
    """

    json: bool = False
    """Print the result as JSON."""
    needs: tuple[str, ...] = ()
    """Extras that have to be there, as in --needs poses film; the exit code is 1 if one is not."""


def run_doctor(options: DoctorOptions) -> int:
    """Inspect the installation, print the result, and return the exit code."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.installation import check_needs, inspect_installation

    check_needs(options.needs)

    parts = list(inspect_installation())
    if options.json:
        print(json.dumps([asdict(part) for part in parts], indent=2))
    else:
        print_parts(parts)
    lacking = [
        p.name for p in parts if p.kind == "extras" and p.name in options.needs and not p.there
    ]
    return ERROR if lacking else DONE


def print_parts(parts: Sequence[Found]) -> None:
    """Print a line for each part, below the name of its kind."""
    width = max(len(part.name) for part in parts)
    for kind, parts_of_kind in groupby(parts, lambda part: part.kind):
        print(f"{kind}:")
        for part in parts_of_kind:
            command = "" if part.install is None else f": {part.install}"
            print(f"  {part.name:{width}}  {'' if part.there else 'missing: '}{part.told}{command}")
