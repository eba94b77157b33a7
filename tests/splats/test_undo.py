"""Edits of a splat, taken off one by one: rows, columns and headers of each earlier state."""

from __future__ import annotations

import json
import random
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter import load_ply, load_splat, save_ply, save_splat
from gscompleter.apps.inputs.earlier_work import read_rows
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.apps.report.scenes import save_completed_splat
from gscompleter.splats.edits import (
    AppendedRows,
    EditDraft,
    hash_given,
    read_edits,
    record_edit,
    rename_edited,
)
from gscompleter.splats.provenance import RunRecord
from gscompleter.splats.row_kinds import count_row_kinds
from gscompleter.splats.undo import strip_edits
from gscompleter.system.errors import InputError
from gscompleter.system.files.ply import read_ply_file, write_ply_file
from gscompleter.types import Gaussians
from scenes import random_gaussians

NUM_EDITS = 6


def edit(splat: Path, folder: Path, number: int, has_record: bool = True) -> Path:
    """Remove some Gaussians of a splat at random, and add others."""
    context = load_splat(splat)
    generator = torch.Generator().manual_seed(number)
    # The third edit only adds, and the fourth only removes.
    changed = torch.rand(len(context), generator=generator) < (0.0 if number == 3 else 0.2)
    added = random_gaussians(0 if number == 4 else 5 * number, seed=number)
    added = replace(added, generated=torch.full_like(added.generated, number))
    run = RunRecord("gscompleter", "x", (number, number), seed=number, given=hash_given(splat))
    run = run if has_record else None
    folder.mkdir()
    splat_file = InputSplatFile(splat)
    save_completed_splat(folder, context, changed, added, splat_file, run)
    draft = EditDraft("complete" if has_record else "clean", seed=number)
    half = len(added) // 2
    appended = [AppendedRows("photographs", half), AppendedRows("target", len(added) - half)]
    record_edit(folder, draft, len(context), appended, splat, splat_file.edits, run)
    return folder / "completed.ply"


@pytest.fixture(scope="module")
def states(tmp_path_factory) -> list[Path]:
    """Write a splat with a column of its own, and edit it again and again."""
    folder = tmp_path_factory.mktemp("edits")
    splat = folder / "splat.ply"
    save_ply(splat, random_gaussians(60))
    layout = read_ply_file(splat, (), "scene")
    header = layout.header.replace(b"end_header", b"comment of its owner\nend_header")
    write_ply_file(splat, header, len(layout.rows), [layout.rows], layout.trailer)
    states = [splat]
    for number in range(1, NUM_EDITS + 1):
        # Cleanings name nobody who made the file.
        states.append(edit(states[-1], folder / str(number), number, has_record=number != 4))
    return states


def test_the_last_edits_are_taken_off_byte_for_byte(states, tmp_path):
    for number in range(1, NUM_EDITS + 1):
        out = tmp_path / f"{number}.ply"
        undone = strip_edits(states[-1], out, range(number, NUM_EDITS + 1))
        assert out.read_bytes() == states[number - 1].read_bytes()
        assert undone.is_same_file
        assert undone.kept == len(load_ply(out))
    undone = strip_edits(states[-1], tmp_path / "all.ply")
    assert (tmp_path / "all.ply").read_bytes() == states[0].read_bytes()
    assert undone.is_same_file


def find_rows(scene: Gaussians) -> set[tuple[float, ...]]:
    return {tuple(row) for row in scene.means.tolist()}


@pytest.mark.parametrize("numbers", [[2], [1, 3], [2, 5], [1, 2, 4, 6]])
def test_edits_from_the_middle_are_taken_off(states, numbers, tmp_path):
    out = tmp_path / "out.ply"
    strip_edits(states[-1], out, numbers)
    # What is left is what the other edits added, without what they removed.
    expected = find_rows(load_ply(states[0]))
    for number in range(1, NUM_EDITS + 1):
        before, after = (find_rows(load_ply(states[index])) for index in (number - 1, number))
        if number not in numbers:
            expected |= after - before
    for number in range(1, NUM_EDITS + 1):
        before, after = (find_rows(load_ply(states[index])) for index in (number - 1, number))
        if number not in numbers:
            expected -= before - after
    assert find_rows(load_ply(out)) == expected


def count_kinds(splat: Path) -> dict[str, int] | None:
    return count_row_kinds(splat, read_edits(splat), len(load_ply(splat)))


def test_rows_are_counted_by_their_kind_after_all_edits(states):
    counts = count_kinds(states[-1])
    first = find_rows(load_ply(states[0]))
    shown, invented = set(), set()
    for number in range(1, NUM_EDITS + 1):
        added = random_gaussians(0 if number == 4 else 5 * number, seed=number)
        shown |= find_rows(added[: len(added) // 2])
        invented |= find_rows(added[len(added) // 2 :])
    last = find_rows(load_ply(states[-1]))
    expected = {"given": first, "photographs": shown, "target": invented}
    assert counts == {kind: len(rows & last) for kind, rows in expected.items()}
    assert sum(counts.values()) == len(load_ply(states[-1]))


def test_kinds_that_no_record_tells_are_not_known(states, tmp_path):
    alone = tmp_path / "alone.ply"
    shutil.copyfile(states[-1], alone)
    assert count_kinds(alone) is None
    # Earlier versions did not tell.
    folder = shutil.copytree(states[1].parent, tmp_path / "earlier")
    content = json.loads((folder / "edits.json").read_text())
    kinds = content["edits"][0].pop("appended")
    (folder / "edits.json").write_text(json.dumps(content))
    assert count_kinds(folder / "completed.ply") is None
    content["edits"][0]["appended"] = [{**kinds[0], "count": kinds[0]["count"] + 1}]
    (folder / "edits.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="do not add up"):
        count_kinds(folder / "completed.ply")


def test_a_record_that_does_not_fit_is_refused(states, tmp_path):
    record = states[-1].with_name("edits.json")
    text = record.read_text()
    try:
        for change, sentence in (
            (lambda c: c["edits"][0].update(rows=7), "do not lead"),
            (lambda c: c["edits"][0].update(rows=10**15), "do not lead"),
            (lambda c: c["edits"][-1].update(added=7), "do not lead"),
            (lambda c: c["edits"][-1].update(added=-7), "do not lead"),
            (lambda c: c["edits"][0].update(originals="../x.ply"), r"names \.\./x\.ply"),
            (lambda c: c["edits"][0].update(originals="edits/9_originals.ply"), "is missing"),
            (lambda c: c.update(edits=3), "edits"),
            (lambda c: c.update(format=99), "later version"),
        ):
            content = json.loads(text)
            change(content)
            record.write_text(json.dumps(content))
            with pytest.raises(InputError, match=sentence):
                strip_edits(states[-1], tmp_path / "out.ply", [1, NUM_EDITS - 1])
    finally:
        record.write_text(text)


def test_gaussians_that_labels_do_not_tell_are_counted(states, tmp_path):
    folder = shutil.copytree(states[2].parent, tmp_path / "changed")
    splat = folder / "completed.ply"
    scene = load_ply(splat)
    save_ply(splat, replace(scene, means=scene.means + 0.01), provenance=True)
    undone = strip_edits(splat, tmp_path / "out.ply")
    # What the first edit left out stays out.
    assert undone.kept == len(load_ply(tmp_path / "out.ply"))
    assert undone.missing == len(load_ply(states[0])) - undone.kept > 0


@pytest.mark.parametrize("keeps_labels", [True, False])
def test_edits_after_a_change_by_another_program_are_taken_off(states, tmp_path, keeps_labels):
    changed = shutil.copytree(states[1].parent, tmp_path / "changed") / "completed.ply"
    scene = load_ply(changed)[:-1]
    if not keeps_labels:
        scene = replace(scene, generated=torch.zeros_like(scene.generated))
    save_ply(changed, scene)
    between = changed.read_bytes()
    assert (b"generated" in between) == keeps_labels
    second = edit(changed, tmp_path / "second", 2)
    third = edit(second, tmp_path / "third", 3)
    out = tmp_path / "out.ply"
    for numbers, expected in (([3], second.read_bytes()), ([2, 3], between)):
        assert strip_edits(third, out, numbers).is_same_file
        assert out.read_bytes() == expected
    # The rows that the first edit added have no place any more, nor a kind.
    with pytest.raises(InputError, match="changed by another program after edit 1"):
        strip_edits(third, out, [1])
    assert count_kinds(third) is None
    assert read_rows(InputSplatFile(third), load_ply(third), ["target"]) is None


@pytest.mark.parametrize("number", [4, 5, 6])
def test_without_a_record_what_the_last_edit_took_of_the_scene_comes_back(states, tmp_path, number):
    folder = shutil.copytree(states[number].parent, tmp_path / "moved")
    (folder / "edits.json").unlink()
    # It took out Gaussians that earlier edits had invented as well.
    assert load_ply(folder / "removed.ply").generated.any()
    strip_edits(folder / "completed.ply", tmp_path / "out.ply")
    before = load_ply(states[number - 1])
    observed = before[before.generated == 0]
    assert torch.equal(load_ply(tmp_path / "out.ply").means, observed.means)
    strip_edits(folder / "completed.ply", tmp_path / "out.spz")
    assert len(load_splat(tmp_path / "out.spz")) == len(observed)


def save_in_format(splat: Path, suffix: str) -> Path:
    """Write the last state of a splat in another format, as commands keep results."""
    small = splat.with_suffix(suffix)
    save_splat(small, load_ply(splat))
    splat.unlink()
    rename_edited(splat.parent, small)
    return small


@pytest.mark.parametrize("has_record", [True, False])
def test_labels_of_a_splat_in_another_format_stay(states, tmp_path, has_record):
    folder = shutil.copytree(states[1].parent, tmp_path / "1")
    small = save_in_format(folder / "completed.ply", ".spz")
    if not has_record:
        (folder / "edits.json").unlink()
    second = edit(small, tmp_path / "second", 2)
    third = edit(second, tmp_path / "third", 3)
    strip_edits(third, tmp_path / "out.ply", [2, 3] if has_record else [1, 2])
    assert load_ply(tmp_path / "out.ply").generated.tolist() == load_splat(small).generated.tolist()


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
@pytest.mark.parametrize("numbers", [None, [1]])
def test_labels_before_the_only_edit_stay(tmp_path, suffix, numbers):
    """Another program put what was generated first, so that no edit explains these labels."""
    scene = random_gaussians(20)
    scene.generated[:5] = 1
    splat = tmp_path / f"given{suffix}"
    save_splat(splat, scene)
    completed = edit(splat, tmp_path / "first", 2)
    assert len(read_edits(completed).edits) == 1
    out = tmp_path / "out.ply"
    undone = strip_edits(completed, out, numbers)
    assert (undone.kept, undone.missing) == (20, 0)
    assert load_ply(out).generated.tolist() == scene.generated.tolist()
    assert undone.is_same_file == (suffix == ".ply")


def test_labels_that_the_only_edit_left_out_come_back(tmp_path):
    scene = random_gaussians(20)
    scene.generated[:5] = 1
    splat = tmp_path / "given.ply"
    save_ply(splat, scene)
    (tmp_path / "first").mkdir()
    splat_file = InputSplatFile(splat)
    changed = scene.generated > 0
    save_completed_splat(tmp_path / "first", scene, changed, scene[:0], splat_file, None)
    record_edit(tmp_path / "first", EditDraft("clean"), 20, [], splat, splat_file.edits, None)
    assert strip_edits(tmp_path / "first" / "completed.ply", tmp_path / "out.ply").is_same_file
    assert (tmp_path / "out.ply").read_bytes() == splat.read_bytes()


def test_a_column_of_bytes_comes_back_whatever_white_space_its_line_has(tmp_path):
    scene = random_gaussians(20)
    scene.generated[:5] = 1
    splat = tmp_path / "given.ply"
    save_ply(splat, scene)
    layout = read_ply_file(splat, (), "scene")
    header = layout.header.replace(b"property float generated", b"property\tuchar\tgenerated")
    columns = [(c[0], "u1" if c[0] == "generated" else c[1]) for c in layout.rows.dtype.descr]
    write_ply_file(splat, header, 20, [layout.rows.astype(columns)], layout.trailer)
    second = edit(edit(splat, tmp_path / "first", 1), tmp_path / "second", 2)
    assert strip_edits(second, tmp_path / "out.ply").is_same_file
    assert (tmp_path / "out.ply").read_bytes() == splat.read_bytes()


def test_rows_that_a_format_sorted_are_not_taken_off(states, tmp_path):
    small = save_in_format(
        shutil.copytree(states[1].parent, tmp_path / "1") / "completed.ply", ".sog"
    )
    again = edit(small, tmp_path / "again", 2)
    with pytest.raises(InputError, match="in a format that sorts Gaussians"):
        strip_edits(again, tmp_path / "out.ply", [1])
    strip_edits(again, tmp_path / "out.ply", [2])
    assert len(load_ply(tmp_path / "out.ply")) == len(load_splat(small))


def test_all_edits_at_once_are_taken_off_another_format_than_ply(states, tmp_path):
    small = save_in_format(
        shutil.copytree(states[2].parent, tmp_path / "2") / "completed.ply", ".spz"
    )
    with pytest.raises(InputError, match=r"is no \.ply, of which alone edits"):
        strip_edits(small, tmp_path / "out.ply", [2])
    strip_edits(small, tmp_path / "out.ply")
    assert not load_ply(tmp_path / "out.ply").generated.any()


def test_an_edit_that_left_out_everything_is_taken_off(tmp_path):
    splat = tmp_path / "splat.ply"
    save_ply(splat, random_gaussians(20))
    first = edit(splat, tmp_path / "first", 1)
    context = load_ply(first)
    (tmp_path / "second").mkdir()
    splat_file = InputSplatFile(first)
    everything = torch.ones(len(context), dtype=torch.bool)
    save_completed_splat(tmp_path / "second", context, everything, context[:0], splat_file, None)
    record_edit(
        tmp_path / "second", EditDraft("remove"), len(context), [], first, splat_file.edits, None
    )
    emptied = tmp_path / "second" / "completed.ply"
    assert strip_edits(emptied, tmp_path / "out.ply", [2]).is_same_file
    assert (tmp_path / "out.ply").read_bytes() == first.read_bytes()


def edit_in_another_degree(splat: Path, folder: Path) -> Path:
    """Replace the first Gaussian of a splat by two with harmonics of degree 1."""
    context = load_ply(splat)
    changed = torch.arange(len(context)) == 0
    added = random_gaussians(2, seed=1)
    sh = torch.rand((2, 4, 3), generator=torch.Generator().manual_seed(0))
    added = replace(added, sh=sh, generated=torch.ones_like(added.generated))
    folder.mkdir()
    splat_file = InputSplatFile(splat)
    save_completed_splat(folder, context, changed, added, splat_file, None)
    appended = [AppendedRows("target", 2)]
    record_edit(
        folder, EditDraft("complete"), len(context), appended, splat, splat_file.edits, None
    )
    return folder / "completed.ply"


def test_the_only_edit_is_taken_off_by_its_number_as_well(tmp_path):
    splat = tmp_path / "splat.ply"
    save_ply(splat, random_gaussians(20))
    completed = edit_in_another_degree(splat, tmp_path / "first")
    for numbers in ([1], None):
        assert strip_edits(completed, tmp_path / "out.ply", numbers).is_same_file
        assert (tmp_path / "out.ply").read_bytes() == splat.read_bytes()
    # Nobody who takes off all edits is told to do so.
    again = edit_in_another_degree(completed, tmp_path / "second")
    with pytest.raises(InputError, match="take the file that the first of them was given"):
        strip_edits(again, tmp_path / "out.ply")


@pytest.mark.parametrize("name", ["removed.ply", "edits/1_originals.ply", "edits/new.ply"])
def test_what_edits_left_out_is_not_written_over(states, tmp_path, monkeypatch, capsys, name):
    folder = Path(shutil.copytree(states[2].parent, tmp_path / "2"))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    words = ("strip", folder / "completed.ply", "--out", folder / name, "--overwrite")
    assert run(monkeypatch, *words) == 2
    assert f"The output {folder / name} " in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_it_is_said_which_file_came_back(states, tmp_path, monkeypatch, capsys):
    for number, (words, place) in enumerate([((), "all edits"), (("--last",), "this edit")]):
        out = tmp_path / f"{number}.ply"
        assert run(monkeypatch, "strip", states[2], *words, "--out", out) == 0
        assert capsys.readouterr().out.endswith(
            f"The file is the one before {place}, byte for byte.\n"
        )


def test_other_splats_of_the_folder_have_no_edits(states, tmp_path):
    folder = tmp_path / "out"
    shutil.copytree(states[-1].parent, folder)
    save_ply(folder / "context.ply", load_ply(states[0]))
    assert len(read_edits(folder / "completed.ply").edits) == NUM_EDITS
    assert not read_edits(folder / "context.ply")
    # The same bytes under another name are the same splat; others under its name are a later state.
    (folder / "completed.ply").rename(folder / "mine.ply")
    assert read_edits(folder / "mine.ply").is_unchanged
    (folder / "context.ply").rename(folder / "completed.ply")
    changed = read_edits(folder / "completed.ply")
    assert len(changed.edits) == NUM_EDITS
    assert not changed.is_unchanged


def test_random_bytes_of_a_record_end_in_a_sentence(states):
    record = states[-1].with_name("edits.json")
    given = record.read_bytes()
    generator = random.Random(0)
    sentences = []
    try:
        for _ in range(60):
            content = bytearray(given)
            for _ in range(3):
                content[generator.randrange(len(content))] = generator.randrange(256)
            record.write_bytes(content[: generator.choice([len(content), len(content) // 2])])
            # Some changes are within a text, and read.
            with suppress(InputError):
                read_edits(states[-1])
                continue
            sentences.append(1)
    finally:
        record.write_bytes(given)
    assert len(sentences) > 20
