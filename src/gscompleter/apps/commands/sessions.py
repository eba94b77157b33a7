"""Decide what a session of `live` begins with: a scene, or a session that was kept in a folder.

Its options are kept in `strokes.json`, so that `live OUT` needs no others, and `repair --strokes`
takes some of them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from gscompleter.apps.command_line.chosen_config import ChosenConfig
from gscompleter.apps.commands.shared_decisions import (
    check_context,
    check_generator,
    decide_config,
    decide_filling,
    decide_results,
    has_splat_alone,
)
from gscompleter.apps.commands.shared_options import (
    WORDS_OR_PATHS,
    CompletingOptions,
    list_inputs,
    may_be_path,
)
from gscompleter.apps.live.opening import SessionRequest
from gscompleter.apps.live.strokes import (
    SEPARATE_OPTIONS,
    STROKES_ADVICE,
    StrokesFile,
    find_strokes_file,
    read_steps,
    read_strokes,
)
from gscompleter.apps.report.schema import find_completed
from gscompleter.apps.requests.completion import CompletionRequest, TargetRequest
from gscompleter.apps.requests.scene import AloneRequest
from gscompleter.config import CompleterConfig
from gscompleter.config.generators import GeneratorOptions
from gscompleter.splats.edits import read_edits
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import holds_results, holds_session
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.result_names import COMPLETED_FILES, STROKES_FILE
from gscompleter.system.files.typed_json import validate_typed
from gscompleter.system.plugins import is_in_file

DEFAULT_OUT = Path("live")
"""Output folder of a session that begins with a scene."""
DEFAULT_RESOLUTION = (256, 256)
"""Working size of such a session."""
SCENE_PATHS = ("folder", "scene")
"""Options that name the scene."""
OPTIONS_OF_A_RUN = (
    *("out", "overwrite", "quiet", "json", "threads"),
    *("device", "renderer_device", "network_device"),
)
"""Options that each run chooses anew, which a session does not keep."""

CODE_OPTIONS = {"config": "config.guards", "synthesis": "generator"}
"""Options by which a program is named, of groups of options; others have the name of their own."""

AnyOptions = TypeVar("AnyOptions", bound=CompletingOptions)


def decide_session(options: AnyOptions, strokes: Path | None) -> SessionRequest:
    """Decide on the scene of a session, and on the steps of `strokes` that it goes on from.

    Raises InputError if its folder is not free.
    """
    options, path = find_session(options, strokes)
    if path is None:
        out = options.out or DEFAULT_OUT
        # A size of 0 is refused by who reads the photographs, not taken for none.
        size = DEFAULT_RESOLUTION if options.resolution is None else options.resolution
        options = replace(options, out=out, resolution=size)
        if holds_session(out) and not options.overwrite:
            raise InputError(
                f"{quote_value(out)} holds a session; go on with it by `gscompleter live "
                f"{quote_value(out)}`, name another folder, or begin anew in it.",
                "overwrite",
            )
        # A session saves several times, and reads its splat each time.
        refuse_overlap(out, list_inputs(options), may_continue=False)
        return begin_with(options)

    saved = read_strokes(path)
    is_named = options.folder is not None or options.scene is not None
    out = options.out or (DEFAULT_OUT if is_named else path.parent)
    continues = path.name == STROKES_FILE and is_same_path(path.parent, out)
    if is_named:
        options = add_saved_options(options, saved)
    else:
        options = restore_options(options, saved, path)
    options = replace(options, out=out, overwrite=options.overwrite or continues)
    inputs = [*list_inputs(options), *(() if continues else (path,))]
    refuse_overlap(out, inputs, may_continue=False)
    begun = begin_with(options)
    return replace(
        begun,
        steps=read_steps(saved.frames, path.parent),
        undone=read_steps(saved.undone, path.parent),
        saved=saved.saved if continues else None,
        notes=tuple(describe_continuation(begun, saved, continues)),
    )


def decide_replay(options: CompletingOptions, strokes: Path) -> SessionRequest:
    """Decide on the scene on which the steps of a `strokes.json` are done again."""
    path = find_strokes_file(strokes)
    saved = read_strokes(path)
    if not saved.frames:
        raise InputError(f"{quote_value(path)} has no steps; {STROKES_ADVICE}.", "strokes")
    begun = begin_with(add_saved_options(options, saved))
    return replace(
        begun,
        steps=read_steps(saved.frames, path.parent),
        notes=tuple(describe_session_changes(begun, saved)),
    )


def begin_with(options: CompletingOptions) -> SessionRequest:
    """Decide on a session without steps, with a record of its options."""
    check_context(options.context)
    check_generator(options.synthesis.generator)
    completion = decide_filling(
        options,
        # A session begins wherever the splat looks well, if nothing tells where its cameras were.
        TargetRequest(),
        decide_results(options),
        context=options.context,
        synthesis=options.synthesis,
        has_marks=False,
    )
    return SessionRequest(completion, describe_session(options, completion), options.resolution)


def add_saved_options(options: AnyOptions, saved: StrokesFile) -> AnyOptions:
    """Return the options with those of the session where they are not given."""
    given = {name: getattr(options, name) for name in SEPARATE_OPTIONS}
    missing = {name: getattr(saved, name) for name, value in given.items() if value is None}
    return replace(options, **missing)


def describe_session(options: CompletingOptions, completion: CompletionRequest) -> dict[str, Any]:
    """Describe what a session began with, for its `strokes.json`."""
    splat = completion.work.splat
    scene = None if splat is None else os.path.abspath(splat.path)
    folder = None if has_splat_alone(options) else describe_value("folder", options.folder)
    config = describe_config(completion.work.config)
    described = {**describe_options(options), "folder": folder, "scene": scene, "config": config}
    if isinstance(completion.source, AloneRequest):
        # A setting may have said so in place of the option.
        described["holes"] = completion.source.holes
    return described


def describe_options(options: CompletingOptions) -> dict[str, Any]:
    """Describe the options that a session goes on with, without those of a run."""
    names = [field.name for field in fields(CompletingOptions)]
    chosen = [name for name in names if name not in (*SEPARATE_OPTIONS, *OPTIONS_OF_A_RUN)]
    return {name: describe_value(name, getattr(options, name)) for name in chosen}


def describe_config(config: CompleterConfig) -> dict[str, Any]:
    """Describe all settings of the method as JSON."""
    described: dict[str, Any] = describe_value("config", asdict(config))
    return described


def describe_value(name: str, value: Any) -> Any:
    """Describe the value of an option as JSON; paths are absolute, as a later run is elsewhere."""
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {inner: describe_value(inner, part) for inner, part in value.items()}
    if isinstance(value, tuple | list):
        return [describe_value(name, part) for part in value]
    if is_in_file(value):
        file, _, attribute = value.rpartition(":")
        return f"{os.path.abspath(file)}:{attribute}"
    is_path = isinstance(value, Path)
    if name in WORDS_OR_PATHS and isinstance(value, str):
        is_path = may_be_path(name, value) and os.path.exists(value)
    return os.path.abspath(value) if is_path else value


def find_session(options: AnyOptions, strokes: Path | None) -> tuple[AnyOptions, Path | None]:
    """Find the `strokes.json` to go on with; None to begin anew.

    SCENE may name the session itself: its folder, or the completed scene in it. Then the options
    that are returned name no scene, which the session knows. An output folder without steps stands
    for the completed scene in it. Raises InputError if a second scene or session is named, too.
    """
    folder = options.folder
    path = None if strokes is None else find_strokes_file(strokes)
    if folder is None:
        return options, path
    if options.scene is not None:
        # A session holds no photographs, and its steps would not be done.
        if holds_session(folder):
            raise InputError(
                f"{quote_value(folder)} holds a session, which knows its scene; leave --scene out, "
                f"or do its steps on another one with --strokes {quote_value(folder)}.",
                "scene",
            )
        return options, path
    if os.path.isdir(folder):
        if holds_session(folder):
            own = folder / STROKES_FILE
            if path is not None and not is_same_path(own, path):
                raise InputError(
                    f"{quote_value(folder)} holds steps of its own; name its scene, or leave "
                    "the others out.",
                    "strokes",
                )
            return replace(options, folder=None), own
        completed = find_completed(folder)
        if holds_results(folder) and completed.is_file():
            return replace(options, folder=completed), path
    elif is_saved_session(folder):
        own = folder.with_name(STROKES_FILE)
        if path is None or is_same_path(own, path):
            return replace(options, folder=None), own
    return options, path


def is_same_path(one: Path, other: Path) -> bool:
    """Check whether two paths lead to the same place, be there anything or not."""
    return os.path.realpath(one) == os.path.realpath(other)


def is_saved_session(path: Path) -> bool:
    """Return True for the completed scene of a session, as the session saved it."""
    if path.name not in COMPLETED_FILES or not holds_session(path.parent):
        return False
    if read_strokes(path.with_name(STROKES_FILE)).session is None:
        return False
    # What another program or command changed is a splat of its own.
    edits = read_edits(path)
    return edits.is_unchanged and bool(edits) and edits.edits[-1].command == "live"


def restore_options(options: AnyOptions, saved: StrokesFile, path: Path) -> AnyOptions:
    """Return the options that a session began with, and those of this run as they are given.

    Raises InputError if an option is given that differs from the session's, or if its scene is
    missing.
    """
    shown = quote_value(path)
    if saved.session is None or not any(saved.session.get(name) for name in SCENE_PATHS):
        raise InputError(
            f"{shown} does not tell of which scene it is; name the scene, as in "
            f"`gscompleter live splat.ply --strokes {shown}`.",
        )
    known = {**saved.session, **{name: getattr(saved, name) for name in SEPARATE_OPTIONS}}
    restored = read_known_options(options, known, shown)
    for name in SCENE_PATHS:
        scene = getattr(restored, name)
        if scene is not None and not os.path.exists(scene):
            raise InputError(
                f"{quote_value(scene)} is missing, with which the session began; name it where it "
                f"is now, as in `gscompleter live splat.ply --strokes {shown}`.",
            )
    refuse_changes(options, restored, known)
    return restored


def read_known_options(options: AnyOptions, known: Mapping[str, Any], shown: str) -> AnyOptions:
    """Read the options that a file keeps; those of a run are of `options`.

    `known` is what is kept by name, and `shown` the name of the file. Raises InputError if it is
    damaged.
    """
    kind = type(options)
    kept = known.get("config", {})
    config = validate_typed(CompleterConfig, kept, shown, STROKES_ADVICE)
    # All settings are changes here, so that no preset decides on any of them again, but on those
    # that an earlier version did not know.
    settings = select_settings(asdict(config), kept)
    # A kind of holes that only the option decided on is not among the settings, which have "all"
    # then. As a change, that would contradict the option. Where "all" was given, the option as it
    # is kept says so, too, or has the same effect.
    if config.holes.kind == "all":
        settings.get("holes", {}).pop("kind", None)

    # Of this run are its own options, and those of the command that no completion has.
    own = {field.name for field in fields(kind)}
    own -= {field.name for field in fields(CompletingOptions)} - set(OPTIONS_OF_A_RUN)
    values = {
        **known,
        **{name: getattr(options, name) for name in own},
        "config": ChosenConfig(changes=settings),
    }
    restored: AnyOptions = validate_typed(kind, values, shown, STROKES_ADVICE)
    return restored


def select_settings(settings: Mapping[str, Any], kept: Mapping[str, Any]) -> dict[str, Any]:
    """Select the settings, also of groups, that a session has kept."""
    return {
        name: select_settings(value, kept[name]) if isinstance(value, Mapping) else value
        for name, value in settings.items()
        if name in kept
    }


def refuse_changes(options: AnyOptions, restored: AnyOptions, known: Mapping[str, Any]) -> None:
    """Refuse options of this run that differ from those of a session, and programs that it names.

    `restored` are the options of the session, read from what its file keeps, `known`.
    """
    kind = type(options)
    # What is typed are changes of a preset, and which preset depends on the session's options.
    typed_config = decide_config(replace(restored, config=options.config))
    given = {
        **describe_options(options),
        **{name: describe_value(name, getattr(options, name)) for name in SEPARATE_OPTIONS},
        "config": describe_config(typed_config),
    }
    # With the settings that an earlier version did not know.
    known = {**known, "config": describe_config(decide_config(restored))}
    for name, value in given.items():
        # A config that was not typed is the one of the session.
        if name != "config" or options.config != ChosenConfig():
            refuse_other_value(name, value, known.get(name), kind)
    for name, value in known.items():
        refuse_code(name, given.get(name), value)


def refuse_other_value(name: str, given: Any, known: Any, kind: type[CompletingOptions]) -> None:
    """Refuse an option that would change what the steps did, unless it has its default.

    `known` is the value in the file, which is None where an earlier version wrote none.
    """
    if isinstance(given, Mapping) and name != "config":
        told = known if isinstance(known, Mapping) else {}
        for inner, value in given.items():
            refuse_other_value(inner, value, told.get(inner), kind)
    elif given not in [describe_value(name, known), *list_defaults(name, kind)]:
        raise InputError(
            "A session goes on with the settings that it began with; leave this one out, or begin "
            "anew with it.",
            name,
        )


def refuse_code(name: str, given: Any, known: Any) -> None:
    """Refuse to run a file of Python because a session names it, which may come from elsewhere."""
    words = [word for word in list_words(describe_value(name, known)) if is_in_file(word)]
    if words and not set(words) <= set(list_words(given)):
        raise InputError(
            f"The session ran {quote_value(words[0])}, a program; name it again if you trust it.",
            CODE_OPTIONS.get(name, name),
        )


def list_words(value: Any) -> Iterator[str]:
    """List all texts in values of JSON."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from list_words(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from list_words(inner)


def list_defaults(name: str, kind: type[CompletingOptions]) -> list[Any]:
    """List the values of an option, as JSON, that mean that it was not given: one, or none."""
    places = (GeneratorOptions, kind)
    defaults = {field.name: field.default for place in places for field in fields(place)}
    is_known = name in defaults and name != "config"
    return [describe_value(name, defaults[name])] if is_known else []


def describe_continuation(
    begun: SessionRequest, saved: StrokesFile, continues: bool
) -> Iterator[str]:
    """Say how many steps are done again, and what is another than it was.

    `continues` is True for a session that goes on in its own folder.
    """
    count = len(saved.frames)
    yield f"Going on after {count} {'step' if count == 1 else 'steps'}, which are done again."
    yield from describe_session_changes(begun, saved)
    if not continues:
        return
    completed = find_completed(begun.out)
    if completed.is_file() and not read_edits(completed).is_unchanged:
        yield f"{quote_value(completed)} was changed by another program; Save replaces it."


def describe_session_changes(begun: SessionRequest, saved: StrokesFile) -> Iterator[str]:
    """Say what the steps are done with that the session did not begin with: splat and options."""
    splat = begun.completion.work.splat
    # A splat in a folder of its own, such as an unpacked .sog, has no SHA-256.
    path = None if splat is None or saved.scene_sha256 is None else splat.path
    if path is not None and path.is_file() and hash_file(path) != saved.scene_sha256:
        yield (
            f"{quote_value(path)} is another file than the session began with; its steps are done "
            "on this one."
        )
    others = list_differences(begun.record, saved.session or {})
    if others:
        yield (
            f"The session began with other values of {', '.join(others)}; its steps are done with "
            "those of this command."
        )


def list_differences(record: Mapping[str, Any], known: Mapping[str, Any]) -> list[str]:
    """List options whose values differ from those of a session, but for those of its scene."""
    names: list[str] = []
    for name, value in record.items():
        if name in SCENE_PATHS or name not in known:
            continue
        if name == "synthesis" and isinstance(known[name], Mapping):
            names += list_differences(value, known[name])
        elif has_other_value(value, known[name]):
            names.append(f"--{name.replace('_', '-')}")
    return names


def has_other_value(value: Any, known: Any) -> bool:
    """Return True if a value, as JSON, differs from that of a session.

    Settings that the session does not have, of an earlier version, do not count.
    """
    if isinstance(value, Mapping) and isinstance(known, Mapping):
        return any(has_other_value(value[name], known[name]) for name in value if name in known)
    return bool(value != known)
