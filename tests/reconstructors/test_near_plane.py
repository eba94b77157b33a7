"""A near plane is brought forward where surfaces without features stand before it."""

from dataclasses import replace

import pytest
import torch

from gscompleter import View, load_reconstructor
from gscompleter.reconstructors.features.given_range import find_depth_range
from gscompleter.reconstructors.plane_sweep.near_plane import find_near_plane
from gscompleter.reconstructors.scene_range import find_scene_range
from scenes import Room, camera_at, view_of

FRONT = 2.2
"""z-depth of the front of the nearer box."""
CUT = 2.6
FAR = 20.0


def see_white_box(near: float | None = CUT, unit: float = 1.0) -> list[View]:
    """Take two photographs of the room, in which the nearer box is white."""
    views = []
    for x in (-0.3, 0.1):
        camera = camera_at(x, size=128, unit=unit)
        planes = {"near": near and near * unit, "far": near and FAR * unit}
        view = view_of(Room(unit=unit), replace(camera, **planes))
        is_box = (view.depth < (FRONT + 0.05) * unit)[..., None]
        # A little shading, as of a smooth arm of a chair
        rows = torch.linspace(0.8, 0.9, 128)[:, None, None].expand_as(view.image)
        views.append(replace(view, image=rows.where(is_box, view.image)))
    return views


@pytest.mark.parametrize("unit", [0.001, 1.0])
def test_a_smooth_surface_before_the_near_plane_brings_it_forward(unit):
    views = see_white_box(unit=unit)
    # Features do not show it.
    assert find_depth_range(views).notes == ()
    assert find_near_plane(views, CUT * unit, FAR * unit) == pytest.approx(CUT / 2 * unit)
    # Without the box, which reaches to 3, nothing stands nearer.
    away = [replace(v, ignore_mask=v.depth < 3.1 * unit) for v in views]
    assert find_near_plane(away, CUT * unit, FAR * unit) == CUT * unit


def test_a_near_plane_before_all_surfaces_stays():
    views = see_white_box()
    for near in (2.0, 1.0, 0.5):
        assert find_near_plane(views, near, FAR) == near


def test_what_matches_nowhere_moves_no_plane():
    """Noise, an even image and one with a little noise match at any plane, wherever they are."""
    generator = torch.Generator().manual_seed(5)
    views = see_white_box()
    noise = [replace(v, image=torch.rand(128, 128, 3, generator=generator)) for v in views]
    even = [replace(v, image=torch.full((128, 128, 3), 0.5)) for v in views]
    grainy = [
        replace(v, image=0.5 + 0.01 * torch.randn(128, 128, 3, generator=generator)) for v in views
    ]
    for kind in (noise, even, grainy):
        assert find_near_plane(kind, CUT, FAR) == CUT


def test_the_range_of_the_scene_is_widened_and_a_given_one_is_told():
    psi = load_reconstructor("plane-sweep")
    found = find_scene_range(psi, see_white_box())
    assert (found.near, found.far) == (CUT / 2, FAR)
    (note,) = found.notes
    assert note.startswith("Surfaces of the photographs stand nearer than the near plane at 2.6")
    assert "widened to 1.3 to 20" in note
    again = find_scene_range(psi, see_white_box(found.near))
    assert (again.near, again.notes) == (found.near, ())
    # An estimated range is not given, and nothing is contradicted.
    assert find_scene_range(psi, see_white_box(None)).notes == ()
