"""Choices of structure from motion: which photographs to match, and which lenses to believe."""

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")

import pycolmap

from gscompleter.data.sfm.mapping_process import Mapped, MappingJob, is_plausible, write_model
from gscompleter.data.sfm.matching import is_sequence, pair_all, pair_neighbours, pair_similar


def test_lenses_that_no_camera_has_are_implausible():
    def camera(focal: float, distortion: float = 0, x: float = 320) -> object:
        return pycolmap.Camera(
            model="SIMPLE_RADIAL", width=640, height=193, params=[focal, x, 96.5, distortion]
        )

    assert is_plausible(camera(344, -0.1))
    assert is_plausible(camera(1488))  # a telephoto lens
    assert not is_plausible(camera(1549, 137))
    assert not is_plausible(camera(22530))
    assert not is_plausible(camera(0))
    assert not is_plausible(camera(344, x=400))


def test_the_focal_length_that_is_told_is_that_of_most_photographs(tmp_path):
    model = pycolmap.Reconstruction()
    for number, focal in ((1, 500.0), (2, 700.0)):
        lens = [focal, 320, 240, 0]
        camera = pycolmap.Camera(
            camera_id=number, model="SIMPLE_RADIAL", width=640, height=480, params=lens
        )
        model.add_camera_with_trivial_rig(camera)
    for number, camera_id in ((1, 1), (2, 1), (3, 2)):
        image = pycolmap.Image(name=f"{number}.png", camera_id=camera_id, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())

    folders = {name: str(tmp_path / name) for name in ("images", "masks", "work", "model")}
    job = MappingJob(**folders, threads=1, photographs=[], is_panoramic=False)
    assert write_model(job, Mapped(model, is_focal_fixed=True))["focal"] == 500


@pytest.mark.parametrize(
    ("names", "counts"),
    [
        (["IMG_0001.jpg", "IMG_0002.jpg"], True),
        (["7.png", "10.png"], True),
        (["2024-05-01 frame 3.png", "2024-05-01 frame 4.png"], True),
        (["left/1.png", "right/2.png"], False),
        (["door.png", "window.png"], False),
    ],
)
def test_names_with_a_number_are_a_sequence(names, counts):
    assert is_sequence(names) is counts


def test_neighbours_reach_ten_on_and_then_by_doubling():
    assert {j for i, j in pair_neighbours(40) if i == 0} == {*range(1, 11), 16, 32}
    assert pair_neighbours(3) == pair_all(3) == {(0, 1), (0, 2), (1, 2)}


def test_photographs_with_the_same_features_look_alike():
    generator = np.random.default_rng(0)
    near, far = (generator.standard_normal((40, 128)).astype(np.float32) for _ in range(2))
    near, far = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (near, far))
    nothing = np.zeros((0, 128), np.float32)
    assert pair_similar([near, far, near[::-1].copy(), nothing]) == {(0, 2)}
