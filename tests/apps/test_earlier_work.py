"""Mark the Gaussians of earlier commands in a splat whose record and labels disagree."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gscompleter import load_ply, save_ply
from gscompleter.apps.inputs.earlier_work import mark_earlier_work
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile
from gscompleter.parts import PartKind
from gscompleter.splats.edits import AppendedRows, EditDraft, Edits, record_edit
from gscompleter.types import merge
from scenes import random_gaussians

NUM_GIVEN = 20
NUM_ADDED = 5


def write_completed(folder: Path, kind: PartKind) -> Path:
    """Write a splat to which Gaussians of one kind were added, with its record."""
    given = random_gaussians(NUM_GIVEN)
    added = random_gaussians(NUM_ADDED, seed=1)
    label = 1 if kind == "target" else 255
    added = replace(added, generated=torch.full_like(added.generated, label))
    save_ply(folder / "given.ply", given)
    save_ply(folder / "completed.ply", merge([given, added]))
    appended = [AppendedRows(kind, NUM_ADDED)]
    draft = EditDraft("complete")
    record_edit(folder, draft, NUM_GIVEN, appended, folder / "given.ply", Edits(folder), None)
    return folder / "completed.ply"


def mark(path: Path) -> tuple[CompletionTask, tuple[str, ...]]:
    task = CompletionTask((), (), np.eye(4), np.zeros(3), {}, load_ply(path), InputSplatFile(path))
    return mark_earlier_work(task)


def move(path: Path, keeps_labels: bool) -> None:
    """Change a splat as another program does."""
    scene = load_ply(path)
    save_ply(path, replace(scene, means=scene.means + 0.01), provenance=keeps_labels)


def test_labels_tell_what_was_invented_after_another_program_kept_them(tmp_path):
    path = write_completed(tmp_path, "target")
    for _ in range(2):
        task, notes = mark(path)
        assert notes == ()
        assert task.earlier.invented is not None
        assert task.earlier.invented.nonzero()[:, 0].tolist() == list(range(NUM_GIVEN, 25))
        move(path, keeps_labels=True)


@pytest.mark.parametrize("kind", ["target", "photographs"])
def test_a_splat_without_its_labels_does_not_count_as_given(tmp_path, kind):
    path = write_completed(tmp_path, kind)
    move(path, keeps_labels=False)
    task, notes = mark(path)
    if kind == "photographs":
        # Nothing was invented, and nothing is said.
        assert notes == ()
        assert task.earlier.invented is not None
        assert not task.earlier.invented.any()
    else:
        assert task.earlier.invented is None
        assert len(notes) == 1
        assert "tells what was invented: that stays" in notes[0]
