"""The command `live`: complete a scene in the browser."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gscompleter.apps.commands.shared_options import CompletingOptions, Port
from gscompleter.apps.requests.scene import Size
from gscompleter.system.process import import_without_collection

if TYPE_CHECKING:
    from gscompleter.apps.live.opening import LiveRequest


@dataclass(frozen=True, kw_only=True)
class LiveOptions(CompletingOptions):
    """Complete and repair a scene in the browser: paint over what is wrong, or fly to a hole.

    The page is that of `view`. What is painted or boxed is removed, filled or repaired, and undone.
    Each step is kept in OUT/strokes.json at once: `gscompleter live OUT` does them again and goes
    on, and undo reaches back into them. Save writes the result.

    Example: gscompleter live splat.ply --out repaired
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """The splat; or the folder of photographs, in any layout that `complete` reads: those of the
    splat that `--scene` names, or of a scene to reconstruct. Or the OUT of a session, or its
    completed.ply, to go on where it was."""
    strokes: Path | None = None
    """The strokes.json that `live` saved. The session goes on from it, on SCENE if it is given."""
    out: Path | None = None  # type: ignore[assignment]
    """Write results here. The folder that keeps the steps, and the results of the Save button. If
    not given, that of the session which goes on, or else `live`."""
    resolution: Size | None = None
    """Size of images in pixels. The working size as in `complete`; smaller is faster. If not given,
    that of the session which goes on, or else 256 x 256."""
    port: Port = 0
    """Port of the page; a free one if not given."""
    host: str = "127.0.0.1"
    """Address of the page, such as 127.0.0.1 or ::1. Whoever has what is printed can use it."""
    no_open: bool = False
    """Print the address without opening a browser."""

    def check_overlap(self) -> None:
        """Leave it to `decide_live`, which knows the inputs of a session that goes on."""


def decide_live(options: LiveOptions) -> LiveRequest:
    """Decide what a session begins with, and where its page is."""
    from gscompleter.apps.commands.sessions import decide_session  # no help page waits for torch
    from gscompleter.apps.live.opening import LiveRequest

    # The file of steps is given beside the options: among them it would count as an input, which a
    # session that goes on in its own folder could not have there.
    without_strokes = replace(options, strokes=None)
    session = decide_session(without_strokes, options.strokes)
    return LiveRequest(session, options.host, options.port, opens_browser=not options.no_open)


def run_live(options: LiveOptions) -> None:
    """Serve the page until Ctrl-C."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.live.serving import serve_live
    serve_live(decide_live(options))
