"""The evaluation index of a protocol."""

from __future__ import annotations

from dataclasses import replace

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.evaluating.cases import print_skipped
from gscompleter.apps.requests.evaluation import IndexRequest
from gscompleter.evaluation import protocols
from gscompleter.evaluation.cases import SkippedScene, filter_usable, list_places, open_clips
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_file import reserve_file
from gscompleter.system.progress import show_preparation, show_progress


def write_index(request: IndexRequest) -> None:
    """Write the evaluation index of a protocol for a data set."""
    skipped: list[SkippedScene] = []
    rule = protocols.parse_protocol(request.protocol)
    with (
        reserve_file(request.out, request.overwrite),
        show_progress(make_console(stderr=True, quiet=request.answer.quiet)),
        show_preparation("reading clips"),
    ):
        # An index chooses frames and scores nothing, so it also names what a file keeps apart.
        clips = (clip for place in list_places(request.path) for clip in open_clips(place.path))
        index = protocols.build_index(rule, filter_usable(clips, skipped))
        # Skipped scenes are recorded as scenes without a case, not left out.
        index = replace(index, scenes={**index.scenes, **{clip.name: () for clip in skipped}})
        if not any(index.scenes.values()):
            reason = f" ({skipped[0].name}: {skipped[0].reason})" if skipped else ""
            raise InputError(
                f"The protocol {quote_value(request.protocol)} chooses no case in the "
                f"{len(index.scenes)} scene(s) of {quote_value(request.path)}{reason}; choose one "
                "with a smaller step, or other data."
            )
        protocols.write_evaluation_index(request.out, index)
    console = make_console(quiet=request.answer.quiet or request.answer.json)
    print_skipped(skipped, console)

    # A split is one choice of context frames, and each of its targets is a case.
    targets = [len(split.targets) for splits in index.scenes.values() for split in splits]
    used = [name for name, splits in index.scenes.items() if splits]
    console.print(
        f"{sum(targets)} cases in {len(used)} scenes, {len(index.scenes) - len(used)} scenes "
        f"skipped: {request.out}",
        soft_wrap=True,
    )
    if request.answer.json:
        print_json(
            {
                "out": str(request.out),
                "cases": sum(targets),
                "scenes": len(used),
                "skipped": {clip.name: clip.reason for clip in skipped},
            }
        )
