"""The command `live`: complete a scene in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.shared_options import CompletingOptions, Port, Size, list_inputs
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class LiveOptions(CompletingOptions):
    """Complete and repair a scene in the browser: paint over what is wrong, or fly to a hole.

    The page is that of `view`. What is painted or boxed is removed, filled or repaired, and undone;
    Save also writes strokes.json, which `repair --strokes` does again.

    Example: gscompleter live splat.ply --out repaired
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """The splat; or the folder of photographs, in any layout that `complete` reads: those of the
    splat that `--scene` names, or of a scene to reconstruct."""
    out: Path = Path("live")
    """Where results go. The folder of the Save button."""
    resolution: Size = (256, 256)
    """Size of images in pixels. The working size as in `complete`; smaller is faster."""
    port: Port = 0
    """Port of the page; a free one if not given."""
    host: str = "127.0.0.1"
    """Address of the page, such as 127.0.0.1 or ::1. Whoever has what is printed can use it."""
    no_open: bool = False
    """Print the address without opening a browser."""

    def check_overlap(self) -> None:
        """Refuse an output that is, holds or lies in an input."""
        # A session saves several times, and reads its splat each time.
        refuse_overlap(self.out, list_inputs(self), may_continue=False)


def run_live(options: LiveOptions) -> None:
    """Serve the page until Ctrl-C."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.live.serving import serve_live
    serve_live(options)
