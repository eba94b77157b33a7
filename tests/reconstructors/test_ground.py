"""The ground below the cameras of a drive, where stereo measures nothing or infinity."""

from dataclasses import replace

import numpy as np
import pytest

from gscompleter.reconstructors.features.neighbours import Neighbours
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
)
from gscompleter.reconstructors.plane_sweep.ground import (
    BACKGROUND_WEIGHT,
    compute_rays,
    find_ground,
    hold_to_ground,
    measure_difference,
    moves_forward,
)
from gscompleter.reconstructors.plane_sweep.rig import Rig
from gscompleter.reconstructors.plane_sweep.sweep import Measurement, compute_plane_index

SIZE = 96
HEIGHT = 1.5
"""Height of the cameras above the road, in widest baselines, as the other lengths."""
PLANES = np.linspace(0.002, 0.5, 128, dtype=np.float32)
NEAR_ROAD = 70
"""First row of the near road, which stereo takes for something far away."""


def paint_road(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Paint even asphalt, with bright and dark stretches along the road."""
    gray = 0.4 + 0.02 * np.sin(2 * x) + 0.1 * np.sin(0.7 * z)
    return np.repeat(gray[..., None], 3, axis=-1)


def see_road(z: float, height: float = HEIGHT) -> tuple[StereoImage, np.ndarray]:
    """Photograph a road forward from (0, 0, z); also return its inverse depth, 0 in the sky."""
    K = np.array([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1.0]])
    x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    # y points down, so that rows below the middle see the road.
    inverse = np.maximum((y - SIZE / 2) / SIZE / height, 0)
    depth = 1 / np.maximum(inverse, 1e-3)
    road = paint_road((x - SIZE / 2) / SIZE * depth, z + depth)
    image = np.where(inverse[..., None] > 0, road, 0.9).astype(np.float32)
    center = np.array([0.0, HEIGHT - height, z])
    given = np.zeros((SIZE, SIZE), np.float32)
    return StereoImage(image, K, np.eye(3), center, given), inverse.astype(np.float32)


def make_rig(images: list[StereoImage]) -> Rig:
    """Relate images by their exact cameras."""
    pairs = [(i, j) for i in range(len(images)) for j in range(len(images)) if i != j]
    transforms = {(i, j): compute_source_from_reference(images[i], images[j]) for i, j in pairs}
    return Rig(images, 1.0, Neighbours(((),) * len(images), {}), transforms)


def measure_road(inverse: np.ndarray) -> Measurement:
    """Measure the far road, nothing in every second row of the near one, and infinity between."""
    index = compute_plane_index(PLANES, inverse)
    confidence = (inverse > 0).astype(np.float32)
    near = np.arange(SIZE)[:, None] >= NEAR_ROAD
    index = np.where(near, np.float32(1), index)
    confidence[NEAR_ROAD::2] = 0
    return Measurement(PLANES, index, confidence, confidence)


@pytest.fixture
def drive():
    """Three photographs of a drive, what is measured in them, and the true inverse depths."""
    seen = [see_road(z) for z in (0.0, 2.0, 4.0)]
    images = [image for image, _ in seen]
    inverses = [inverse for _, inverse in seen]
    return make_rig(images), [measure_road(inverse) for inverse in inverses], inverses


def skies_of(inverses: list[np.ndarray]) -> list[np.ndarray]:
    return [inverse == 0 for inverse in inverses]


def test_the_ground_is_found_below_the_cameras_though_a_third_is_measured_wrong(drive):
    rig, measured, inverses = drive
    ground = find_ground(rig.images, measured, skies_of(inverses))
    assert ground is not None
    heights = ground.measure_heights(np.stack([image.center for image in rig.images]))
    np.testing.assert_allclose(heights, HEIGHT, rtol=0.01)
    # y points down.
    np.testing.assert_allclose(ground.normal, [0, -1, 0], atol=0.01)


def test_the_near_road_lies_on_the_ground(drive):
    rig, measured, inverses = drive
    held = hold_to_ground(rig, measured, skies_of(inverses))
    for number, (before, after, inverse) in enumerate(zip(measured, held, inverses, strict=True)):
        near = np.zeros((SIZE, SIZE), bool)
        near[NEAR_ROAD:] = True
        assert (after.weight[near] == BACKGROUND_WEIGHT).all()
        # Below the view of the others nothing confirms it.
        unconfirmed = near & (after.confidence == 0)
        assert (after.confidence[near & ~unconfirmed] == BACKGROUND_WEIGHT).all()
        compared = np.isfinite(measure_difference(rig, number, inverse))
        np.testing.assert_array_equal(unconfirmed, near & ~compared)
        np.testing.assert_allclose(after.inverse[near], inverse[near], rtol=0.02)
        np.testing.assert_array_equal(after.index[~near], before.index[~near])
        np.testing.assert_array_equal(after.weight[~near], before.weight[~near])


def test_ground_nearer_than_all_that_was_searched_lies_on_the_ground(drive):
    """The rearmost photograph sees nearer road than the others, where the sweep ends."""
    rig, measured, inverses = drive
    planes = PLANES[:40]
    assert planes[-1] < 0.5 * inverses[0].max()
    index = measured[0].index.clip(max=len(planes) - 0.5)
    measured[0] = replace(measured[0], planes=planes, index=index)
    held = hold_to_ground(rig, measured, skies_of(inverses))[0]
    near = np.s_[NEAR_ROAD:]
    np.testing.assert_allclose(held.inverse[near], inverses[0][near], rtol=0.02)
    far = np.s_[:NEAR_ROAD]
    np.testing.assert_array_equal(held.inverse[far], measured[0].inverse[far])


def test_what_stands_on_the_road_stays(drive):
    rig, measured, inverses = drive
    block = np.s_[75:85, 30:60]
    before = measured[1]
    index, weight = before.index.copy(), before.weight.copy()
    index[block] = compute_plane_index(PLANES, 1.2 * inverses[1][block])
    weight[block] = 1
    measured[1] = replace(before, index=index, weight=weight, confidence=weight)
    held = hold_to_ground(rig, measured, skies_of(inverses))[1]
    np.testing.assert_array_equal(held.index[block], index[block])
    np.testing.assert_array_equal(held.confidence[block], weight[block])


def test_what_other_photographs_show_otherwise_is_not_held(drive):
    rig, measured, inverses = drive
    # A red thing on the road in the middle photograph, of which nothing is measured. The others
    # show asphalt where the ground would be.
    image = rig.images[1].image.copy()
    image[72:92, 30:60] = 0.9, 0.1, 0.1
    images = list(rig.images)
    images[1] = replace(images[1], image=image)
    held = hold_to_ground(make_rig(images), measured, skies_of(inverses))[1]
    inner = np.s_[78:86, 36:54]
    np.testing.assert_array_equal(held.index[inner], measured[1].index[inner])
    np.testing.assert_array_equal(held.weight[inner], measured[1].weight[inner])


def test_given_depth_is_left(drive):
    rig, measured, inverses = drive
    given = np.zeros((SIZE, SIZE), np.float32)
    given[80:90] = 0.01
    images = [replace(image, given=given) for image in rig.images]
    held = hold_to_ground(make_rig(images), measured, skies_of(inverses))
    for before, after in zip(measured, held, strict=True):
        np.testing.assert_array_equal(after.index[80:90], before.index[80:90])
        np.testing.assert_array_equal(after.weight[80:90], before.weight[80:90])


def test_ignored_pixels_are_left(drive):
    rig, measured, inverses = drive
    ignored = np.zeros((SIZE, SIZE), bool)
    ignored[80:90] = True
    images = [replace(image, ignore_mask=ignored) for image in rig.images]
    measured = [measurement.exclude(ignored) for measurement in measured]
    held = hold_to_ground(make_rig(images), measured, skies_of(inverses))
    for after in held:
        assert (after.weight[80:90] == 0).all()
        assert (after.weight[75:80] > 0).all()


def test_ignored_pixels_of_other_photographs_confirm_no_ground(drive):
    rig, measured, inverses = drive
    everything = np.ones((SIZE, SIZE), bool)
    images = [
        image if number == 1 else replace(image, ignore_mask=everything)
        for number, image in enumerate(rig.images)
    ]
    held = hold_to_ground(make_rig(images), measured, skies_of(inverses))[1]
    np.testing.assert_array_equal(held.weight, measured[1].weight)
    np.testing.assert_array_equal(held.index, measured[1].index)


def test_cameras_at_different_heights_have_no_ground_below_them():
    seen = [see_road(0.0), see_road(2.0, 1.5 * HEIGHT), see_road(4.0, 2 * HEIGHT)]
    images = [image for image, _ in seen]
    inverses = [inverse for _, inverse in seen]
    measured = [measure_road(inverse) for inverse in inverses]
    assert find_ground(images, measured, skies_of(inverses)) is None
    held = hold_to_ground(make_rig(images), measured, skies_of(inverses))
    assert all(after is before for before, after in zip(measured, held, strict=True))


def see_slope(z: float, is_back: bool, degrees: float) -> tuple[StereoImage, Measurement]:
    """Photograph a slope that leans to the right of the way, forward or back; measure all of it."""
    rotation = np.diag([-1.0, 1.0, -1.0]) if is_back else np.eye(3)
    image = replace(see_road(z)[0], rotation=rotation)
    normal = np.array([np.sin(np.radians(degrees)), -np.cos(np.radians(degrees)), 0.0])
    inverse = np.maximum(-(compute_rays(image) @ normal) / HEIGHT, 0).astype(np.float32)
    confidence = (inverse > 0).astype(np.float32)
    return image, Measurement(PLANES, compute_plane_index(PLANES, inverse), confidence, confidence)


@pytest.mark.parametrize("is_back", [(False, False, False), (True, True, True), (False, True) * 2])
def test_what_leans_far_to_a_side_is_no_ground_whichever_way_cameras_look(is_back):
    for degrees, is_ground in ((8, True), (17, False)):
        seen = [see_slope(2.0 * number, back, degrees) for number, back in enumerate(is_back)]
        images, measured = zip(*seen, strict=True)
        assert moves_forward(images)
        ground = find_ground(images, measured, [m.confidence == 0 for m in measured])
        assert (ground is not None) == is_ground


def test_cameras_that_move_to_a_side_are_left_alone(drive):
    rig, measured, inverses = drive
    # The same cameras turned by 90 degrees look at what passes beside them.
    turned = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    assert moves_forward(rig.images)
    images = [replace(image, rotation=turned) for image in rig.images]
    assert not moves_forward(images)
    held = hold_to_ground(make_rig(images), measured, skies_of(inverses))
    assert all(after is before for before, after in zip(measured, held, strict=True))


def test_a_photograph_with_another_one_near_it_is_left(drive):
    rig, measured, inverses = drive
    beside, inverse = see_road(4.5)
    held = hold_to_ground(
        make_rig([*rig.images, beside]),
        [*measured, measure_road(inverse)],
        skies_of([*inverses, inverse]),
    )
    assert held[2] is measured[2]
    assert held[1] is not measured[1]


def see_road_behind(z: float) -> tuple[StereoImage, np.ndarray]:
    """Photograph the road backward from beside (0, 0, z), as near as rounding puts one place."""
    image, inverse = see_road(z)
    rays = compute_rays(image) * [-1, 1, -1]
    depth = 1 / np.maximum(inverse, 1e-3)[..., None]
    places = image.center + rays * depth
    road = paint_road(places[..., 0], places[..., 2])
    colors = np.where(inverse[..., None] > 0, road, 0.9).astype(np.float32)
    center = image.center + np.array([2.0**-16, 0, 0])
    return replace(image, image=colors, rotation=np.diag([-1.0, 1, -1]), center=center), inverse


def test_photographs_backward_from_the_same_places_leave_the_near_road_on_the_ground(drive):
    rig, _, inverses = drive
    behind = [see_road_behind(z) for z in (0.0, 2.0, 4.0)]
    images = [*rig.images, *(image for image, _ in behind)]
    all_inverses = [*inverses, *(inverse for _, inverse in behind)]
    all_measured = [measure_road(inverse) for inverse in all_inverses]
    held = hold_to_ground(make_rig(images), all_measured, skies_of(all_inverses))
    for after, inverse in zip(held, all_inverses, strict=True):
        assert (after.weight[NEAR_ROAD:] == BACKGROUND_WEIGHT).all()
        np.testing.assert_allclose(after.inverse[NEAR_ROAD:], inverse[NEAR_ROAD:], rtol=0.02)


def test_a_photograph_from_the_same_place_confirms_no_ground(drive):
    rig, _, inverses = drive
    again = make_rig([*rig.images, rig.images[1]])
    expected = measure_difference(rig, 1, inverses[1])
    np.testing.assert_array_equal(measure_difference(again, 1, inverses[1]), expected)


def test_two_photographs_stay_as_they_are(drive):
    rig, measured, inverses = drive
    pair = make_rig(rig.images[:2])
    held = hold_to_ground(pair, measured[:2], skies_of(inverses)[:2])
    assert all(after is before for before, after in zip(measured[:2], held, strict=True))


def test_too_few_measured_points_give_no_ground(drive):
    rig, measured, inverses = drive
    none = [replace(m, confidence=np.zeros_like(m.confidence)) for m in measured]
    assert find_ground(rig.images, none, skies_of(inverses)) is None


def test_differences_are_those_from_the_most_similar_photograph_in_view(drive):
    rig, _, inverses = drive
    difference = measure_difference(rig, 2, inverses[2])
    # The last photograph sees ahead what those behind it see, too, farther away.
    road = inverses[2] > 0.05
    assert np.isfinite(difference[road]).all()
    assert difference[road].max() < 0.05
    # The first one looks from farther behind, so that the lower rows of its road are in nobody's
    # view behind them.
    first = measure_difference(rig, 0, inverses[0])
    assert np.isinf(first[-5:]).all()
