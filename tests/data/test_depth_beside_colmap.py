"""Depth maps beside a COLMAP model: those of 3DGS's training, and of COLMAP's dense stereo."""

import json

import numpy as np
import pytest
from PIL import Image

from exact_room import make_cameras, write_colmap
from gscompleter import InputError
from gscompleter.data.formats import open_photographs
from inverse_depth import write_dense_depth, write_inverse_depth
from measured_photographs import give_depths

CAMERAS = make_cameras(4, width=64, height=48, focal=52.0)


@pytest.fixture
def scene(tmp_path):
    """Write a COLMAP model with photographs."""
    return write_colmap(tmp_path / "room", CAMERAS, n_points=300)


def test_inverse_depth_of_3dgs_is_read_in_the_unit_of_the_cameras(scene):
    photographs = open_photographs(write_inverse_depth(scene, CAMERAS))
    assert photographs.notes == (
        "4 of 4 photographs have inverse depth of 3DGS (depth_params.json).",
    )
    (view,) = photographs.views([2])
    assert view.depth is None  # nothing that may score
    depth = photographs.load_predicted_depth(view).numpy()
    known = depth > 0
    assert known.mean() > 0.99
    assert np.abs(depth / CAMERAS[2].depth - 1)[known].max() < 1e-3


def test_inverse_depth_of_eight_bits_and_three_channels_is_read(scene):
    write_inverse_depth(scene, CAMERAS)
    file = scene / "depths/photo_001.png"
    values = np.asarray(Image.open(file)) // 257
    Image.fromarray(np.stack([values.astype(np.uint8)] * 3, -1)).save(file)
    parameters = json.loads((scene / "sparse/0/depth_params.json").read_text())
    parameters["photo_001"]["scale"] *= 257
    for entry in parameters.values():  # one unit for all, as of a program that writes eight bits
        entry["scale"] = parameters["photo_001"]["scale"]
    (scene / "sparse/0/depth_params.json").write_text(json.dumps(parameters))
    photographs = open_photographs(scene)
    depth = photographs.load_predicted_depth(*photographs.views([1])).numpy()
    assert np.median(np.abs(depth / CAMERAS[1].depth - 1)[depth > 0]) < 0.01


def test_maps_that_3dgs_would_not_trust_are_named(scene):
    write_inverse_depth(scene, CAMERAS, scales={0: 0.0, 3: 1e3})
    photographs = open_photographs(scene)
    assert [frame.predicted_depth is not None for frame in photographs.frames] == [
        False, True, True, False,
    ]  # fmt: skip
    (note,) = photographs.notes
    assert "2 of 4" in note
    assert "that of photo_000.png, photo_003.png is not used" in note


def test_a_list_of_scales_without_maps_says_where_they_are_searched(scene):
    write_inverse_depth(scene, CAMERAS)
    (scene / "depths").rename(scene / "elsewhere")
    (note,) = open_photographs(scene).notes
    assert "0 of 4" in note
    assert "depths, depth, depths_any beside the photographs" in note


@pytest.mark.parametrize("content", ["[]", '{"photo_000": {"scale": "x", "offset": 0}}'])
def test_a_damaged_list_of_scales_is_refused(scene, content):
    write_inverse_depth(scene, CAMERAS)
    (scene / "sparse/0/depth_params.json").write_text(content)
    with pytest.raises(InputError, match=r"depth_params\.json"):
        open_photographs(scene)


def test_dense_depth_of_colmap_is_given(scene):
    photographs = open_photographs(write_dense_depth(scene, CAMERAS))
    assert photographs.notes == ("4 of 4 photographs have depth of COLMAP's dense stereo.",)
    (view,) = photographs.views([1])
    assert not view.depth[:4, :4].any()
    known = view.depth.numpy() > 0
    assert np.allclose(view.depth.numpy()[known], CAMERAS[1].depth[known], rtol=1e-5)
    (given,) = give_depths(photographs, [1])
    assert (given.given_depth > 0).float().mean() > 0.5


def test_a_truncated_dense_depth_map_is_refused(scene):
    write_dense_depth(scene, CAMERAS)
    file = scene / "stereo/depth_maps/photo_001.png.geometric.bin"
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(InputError, match=r"photo_001.*is no depth map of COLMAP, or ends too ear"):
        open_photographs(scene).views([1])
