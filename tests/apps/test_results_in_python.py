"""Files and scores of a completion in Python, beside those of the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import gscompleter as gsc
from command import run
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.apps.report import results
from gscompleter.apps.report.results import find_splat_file, prepare_judged
from gscompleter.apps.report.schema import read_summary
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.system.errors import InputError
from gscompleter.types import ContextScene
from splat_files import sog_files, write_sog

NEAR_FAR = {"near": 0.5, "far": 20.0}


@pytest.fixture(scope="module")
def completion(room) -> gsc.Completion:
    """Complete the room in Python for the same camera as `completed_room`."""
    views = gsc.load_views(room, frames=[0, 1], **NEAR_FAR)
    return gsc.GSCompleter()(views, gsc.load_camera(room, frame=2, **NEAR_FAR))


@pytest.fixture(scope="module")
def saved(completion, room, tmp_path_factory) -> Path:
    photograph = gsc.load_views(room, frames=[2], **NEAR_FAR)
    return completion.save(tmp_path_factory.mktemp("python") / "out", photograph)


def test_scenes_are_those_of_the_command(saved, completed_room):
    for name in ("completed.ply", "context.ply", "generated.ply"):
        assert (saved / name).read_bytes() == (completed_room / name).read_bytes()
    for path in (completed_room / "images").iterdir():
        assert (saved / "images" / path.name).read_bytes() == path.read_bytes()


def test_scores_are_those_of_the_command(saved, completed_room):
    ours, theirs = (
        json.loads((out / "summary.json").read_text()) for out in (saved, completed_room)
    )
    assert ours["outcome"] == theirs["outcome"]
    for row in (*ours["targets"], *theirs["targets"], *ours["context"], *theirs["context"]):
        for name in ("file", "anchor_file", "derived_file"):
            row.pop(name, None)
    assert ours["targets"] == theirs["targets"]
    assert ours["context"] == theirs["context"]
    assert ours["gaussians"] == theirs["gaussians"]
    # The photograph at the target is one of the scene, too.
    assert ours["scene"]["photographs"] == theirs["scene"]["photographs"] == 3
    assert ours["coverage"] == theirs["coverage"]


def test_other_commands_read_the_folder(saved, monkeypatch, tmp_path):
    assert read_summary(saved).scene.format == "python"
    assert run(monkeypatch, "report", saved, "--quiet") == 0
    observed = tmp_path / "observed.ply"
    assert run(monkeypatch, "strip", saved / "completed.ply", "--out", observed) == 0
    assert observed.read_bytes() == (saved / "context.ply").read_bytes()


def test_scores_are_on_the_result(completion, room):
    plain = completion.scores
    assert plain["targets"][0]["psnr_after"] is None
    assert plain["coverage"]["after"] > plain["coverage"]["before"]
    assert plain["context"][0]["psnr_before"] > 20
    scored = completion.score(gsc.load_views(room, frames=[2], **NEAR_FAR))
    assert scored["held_out"] == []
    (target,) = scored["targets"]
    assert target["psnr_after"] > target["psnr_before"]


def test_scores_are_the_same_whatever_the_script_has_switched(completion):
    torch.set_default_dtype(torch.float64)
    try:
        with torch.inference_mode():
            switched = completion.score()
    finally:
        torch.set_default_dtype(torch.float32)
    assert switched == completion.scores


def test_cameras_of_photographs_are_listed_once_in_the_order_of_their_frames(completion, room):
    views = gsc.load_views(room, frames=[0, 1, 2], **NEAR_FAR)
    # As if photograph 1 had checked a splat, and were given again.
    checked = replace(completion, num_context=1)
    found = prepare_judged(checked, [views[2], views[1]]).cameras
    pairs = zip(found, (view.camera for view in views), strict=True)
    assert all(is_same_camera(*pair) for pair in pairs)
    nameless = [replace(view, frame=None) for view in views[1:]]
    assert len(prepare_judged(checked, nameless).cameras) == 4


def test_a_photograph_scores_each_target_at_its_camera(completion, room):
    (view,) = gsc.load_views(room, frames=[2], **NEAR_FAR)
    twice = replace(completion, targets=completion.targets * 2)
    judged = prepare_judged(twice, [replace(view, frame=None)])
    assert [target.photograph is not None for target in judged.targets] == [True, True]
    assert judged.held_out == []
    assert len(judged.cameras) == 3


def test_photographs_of_the_context_do_not_test_it_under_no_name(completion, room):
    views = gsc.load_views(room, frames=[0, 2], **NEAR_FAR)
    nameless = [replace(view, frame=None) for view in views]
    with pytest.raises(InputError, match="^Unused view 1 is part of the context"):
        completion.score([views[1], nameless[0]])
    # So it is where those of the context have no names.
    photos = [replace(photo, view=replace(photo.view, frame=None)) for photo in completion.photos]
    with pytest.raises(InputError, match="unused view of frame 0 is part of the context"):
        gsc.judge(replace(completion, photos=tuple(photos)), views)
    named, unnamed = (gsc.judge(completion, views[1:]) for views in (views, nameless))
    assert "the unused photograph 2 gains" in named.headline
    assert unnamed.headline == named.headline.replace("photograph 2", "photograph")


def test_the_page_alone(completion, tmp_path):
    page = completion.report(tmp_path / "page.html")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert "<html" in page.read_text()


def test_a_page_that_cannot_be_written_is_refused_before_it_is_made(
    completion, tmp_path, monkeypatch
):
    monkeypatch.setattr(results, "prepare_judged", lambda *_: pytest.fail("it was made"))
    with pytest.raises(InputError, match="there is no folder"):
        completion.report(tmp_path / "missing" / "page.html")


def test_a_folder_is_replaced_on_request_only(completion, saved):
    with pytest.raises(InputError, match="is not empty"):
        completion.save(saved)
    with pytest.raises(InputError, match="part of the context"):
        completion.save(saved, completion.views, overwrite=True)


# `test_remove.py` strips the result of the command, and `tests/editing` removes in Python.
@pytest.mark.slow
def test_a_removal_is_undone_by_strip(completion, room, saved, monkeypatch, tmp_path):
    file = saved / "context.ply"
    splat = gsc.load_splat(file)
    views = gsc.load_views(room, frames=[0, 1], **NEAR_FAR)
    chosen = ((splat.means - torch.tensor([-0.1, 0.9, 2.6])).abs() < 0.7).all(dim=1)
    without = gsc.remove(splat, chosen, views, [views[0].camera])
    assert not set(map(tuple, splat.means[chosen].tolist())) & set(
        map(tuple, without.scene.means.tolist())
    )
    assert len(without.added) > 0
    out = without.save(tmp_path / "out", splat=file)
    # Nothing is fitted once more on the way to the file.
    written = gsc.load_ply(out / "completed.ply")
    assert (written.sh - without.scene.sh).abs().max() < 1e-6 * without.scene.sh.abs().max()
    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back) == 0
    assert back.read_bytes() == file.read_bytes()


def test_models_are_recorded_by_their_names(completion):
    assert completion.models == {"reconstructor": "plane-sweep", "generator": "warp-inpaint"}

    def paint(nearest, target, context):
        return context.target_render.image

    own = gsc.GSCompleter(gsc.PlaneSweep(predict_depth=lambda view: None), paint)
    assert own.name_models() == {
        "reconstructor": "plane-sweep",
        "depth": "<lambda>",
        "generator": "paint",
    }


def test_another_file_is_refused(completion, saved):
    with pytest.raises(InputError, match="holds another scene"):
        completion.save(saved.parent / "other", splat=saved / "completed.ply")
    with pytest.raises(InputError, match="There is no splat"):
        completion.save(saved.parent / "other", splat=saved / "none.ply")


def test_a_scene_whose_values_were_changed_is_another_one(completion, saved):
    path = saved / "context.ply"
    scene = gsc.load_splat(path)

    def find(changed: gsc.Gaussians) -> InputSplatFile:
        return find_splat_file(path, replace(completion, source=ContextScene.whole(changed)))

    assert find(scene).path == path
    for name in ("quats", "scales", "opacities", "sh"):
        values = getattr(scene, name).clone()
        values[-1] *= 0.5
        with pytest.raises(InputError, match="holds another scene"):
            find(replace(scene, **{name: values}))


def test_a_scene_of_an_unpacked_sog_is_that_of_its_folder(completion, saved, tmp_path):
    folder = tmp_path / "room"
    write_sog(folder, sog_files(gsc.load_splat(saved / "context.ply")))
    scene = replace(completion, source=ContextScene.whole(gsc.load_splat(folder)))
    assert find_splat_file(folder, scene).path == folder


def test_a_scene_of_a_model_folder_is_its_newest_splat(completion, saved, tmp_path):
    newest = tmp_path / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    newest.parent.mkdir(parents=True)
    newest.write_bytes((saved / "context.ply").read_bytes())
    (tmp_path / "cfg_args").write_text("Namespace()")
    scene = replace(completion, source=ContextScene.whole(gsc.load_splat(tmp_path)))
    assert find_splat_file(tmp_path, scene).path == newest


def test_a_scene_of_which_gaussians_were_dropped_is_that_of_its_file(completion, saved, tmp_path):
    scene = gsc.load_splat(saved / "context.ply")
    path = tmp_path / "broken.ply"
    data = bytearray((saved / "context.ply").read_bytes())
    begin = data.index(b"end_header\n") + len(b"end_header\n")
    row = (len(data) - begin) // len(scene)
    data[begin + 3 * row : begin + 3 * row + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(data)
    kept = gsc.load_splat(path, drop_nonfinite=True)
    found = find_splat_file(path, replace(completion, source=ContextScene.whole(kept)))
    assert found.context_mask.nonzero()[:, 0].tolist() == [0, 1, 2, *range(4, len(scene))]


def test_an_impossible_removal_is_refused(room, saved):
    splat = gsc.load_splat(saved / "context.ply")
    views = gsc.load_views(room, frames=[0, 1], **NEAR_FAR)
    with pytest.raises(InputError, match="No Gaussian is chosen"):
        gsc.remove(splat, torch.zeros(len(splat), dtype=torch.bool), views)
    with pytest.raises(InputError, match="has to be a mask"):
        gsc.remove(splat, torch.zeros(3, dtype=torch.bool), views)
