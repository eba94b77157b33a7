"""PE-Field's positions, rotary tables and transformer against numbers of the authors' code.

The positions need torch alone; what needs diffusers is skipped where that is not installed.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from feed_forward_fixtures import rule_v1
from gscompleter.models.diffusion import rotary
from gscompleter.models.diffusion.position_ids import (
    LEVELS,
    compute_source_ids,
    compute_target_ids,
    pack_cells,
    project_to_target,
)
from gscompleter.models.diffusion.published import PE_FIELD_TRANSFORMER
from gscompleter.models.diffusion.rotary import (
    POSITION_OF_HEAD,
    PerHeadRotary,
    enable_per_head_positions,
)
from gscompleter.types import Camera
from parity import assert_close
from paths import FIXTURES

STORED = FIXTURES / "pefield"
SIZE, GRID = (96, 128), (6, 8)


def stored(name: str) -> dict[str, torch.Tensor]:
    with np.load(STORED / f"{name}.npz") as file:
        return {key: torch.from_numpy(file[key]) for key in file.files}


IDS, TINY = stored("ids"), stored("tiny_transformer")


def levels_of(arrays: dict[str, torch.Tensor], name: str) -> torch.Tensor:
    """Join the stored positions of all levels."""
    return torch.cat([arrays[name.format(level)] for level in range(3)], dim=-1)


def authors_cameras() -> tuple[Camera, Camera]:
    """Load the fixture's cameras; (cx, cy) = (W/2, H/2) is relative to the first pixel's centre."""
    fx, fy = float(IDS["fx"]), float(IDS["fy"])
    K = torch.tensor([[fx, 0, SIZE[1] / 2 + 0.5], [0, fy, SIZE[0] / 2 + 0.5], [0, 0, 1]])
    source = Camera(torch.eye(4), K, SIZE[1], SIZE[0])
    c2w = torch.linalg.inv(IDS["rel_target_from_source"].double()).float()
    return source, replace(source, c2w=c2w)


def test_the_target_positions_are_the_authors():
    found = compute_target_ids(SIZE, GRID, torch.float32)
    assert_close(found, levels_of(IDS, "target_ids_{}"), "target_ids")


def test_the_target_positions_rounded_to_bfloat16_are_the_authors_exactly():
    assert torch.equal(compute_target_ids(SIZE, GRID), levels_of(IDS, "target_ids_bf16_{}"))


def test_the_target_positions_at_1024_pixels_are_the_authors():
    found = compute_target_ids((1024, 1024), (64, 64), torch.float32)[::61]
    assert_close(found, levels_of(IDS, "target_ids_1024_{}_stride"), "target_ids_1024")


def test_the_source_positions_are_the_authors():
    source, target = authors_cameras()
    found = compute_source_ids(IDS["depth"], source, target, GRID, GRID)
    assert_close(found, levels_of(IDS, "source_ids_{}"), "source_ids")


def test_the_target_positions_are_rounded_on_level_2_alone():
    """The authors' bfloat16 rounds by up to an eighth of a token at 1024 pixels."""
    exact, rounded = (
        compute_target_ids((1024, 1024), (64, 64), d) for d in (torch.float32, torch.bfloat16)
    )
    assert torch.equal(exact[:, :15], rounded[:, :15])
    assert (exact - rounded).abs().max() == 0.125


def test_pixels_and_depths_in_the_target_are_the_authors():
    source, target = authors_cameras()
    pixels, z = project_to_target(IDS["depth"], source, target)
    assert_close(pixels, IDS["uv"][0], "uv")
    assert_close(z, IDS["z"][0], "z")


def plain_ids() -> torch.Tensor:
    """Create row and column of each token as in FLUX.1 Kontext."""
    rows, columns = torch.meshgrid(torch.arange(GRID[0]), torch.arange(GRID[1]), indexing="ij")
    return torch.stack([rows, columns], dim=-1).reshape(-1, 2).float()


def centred_camera() -> Camera:
    K = torch.tensor([[110.0, 0, SIZE[1] / 2], [0, 115.0, SIZE[0] / 2], [0, 0, 1]])
    return Camera(torch.eye(4), K, SIZE[1], SIZE[0])


@pytest.mark.parametrize("unit", [1.0, 1e-4, 1e4])
def test_equal_cameras_and_one_depth_give_the_plain_grid_and_the_documented_offset(unit):
    camera, depth = centred_camera(), torch.full(SIZE, 2.0 * unit)
    found = compute_source_ids(depth, camera, camera, GRID, GRID)[:, :3]
    expected = torch.cat([torch.full((48, 1), 1.01), plain_ids() + 7.5 / 16], dim=1)
    assert_close(found, expected, "positions")
    assert torch.equal(compute_target_ids(SIZE, GRID)[:, 1:3], plain_ids())


def test_a_camera_that_moves_by_one_token_moves_the_positions_by_one_token():
    """At depth 2, 16 pixels are 16 * 2 / 110 to the right; the image moves to the left."""
    camera, depth = centred_camera(), torch.full(SIZE, 2.0)
    c2w = torch.eye(4)
    c2w[0, 3] = 16 * 2.0 / 110
    still = compute_source_ids(depth, camera, camera, GRID, GRID).reshape(48, 21, 3)
    moved = compute_source_ids(depth, camera, replace(camera, c2w=c2w), GRID, GRID).reshape(
        48, 21, 3
    )
    assert_close(moved, still + torch.tensor([0.0, 0.0, -1.0]), "positions")


def test_the_number_of_pixels_of_the_target_does_not_matter():
    """Two pixels for each one of the same view; the first one's centre lies half a new pixel in."""
    camera, depth = centred_camera(), IDS["depth"]
    finer = replace(
        camera,
        K=torch.diag(torch.tensor([2.0, 2.0, 1.0])) @ camera.K,
        width=2 * camera.width,
        height=2 * camera.height,
    )
    once = compute_source_ids(depth, camera, camera, GRID, GRID).reshape(48, 21, 3)
    twice = compute_source_ids(depth, camera, finer, GRID, GRID).reshape(48, 21, 3)
    assert_close(twice, once + torch.tensor([0, 0.25 / 16, 0.25 / 16]), "positions")


def test_a_target_that_sees_farther_to_the_left_counts_from_there():
    """Two tokens of 16 pixels more on the left."""
    camera, depth = centred_camera(), IDS["depth"]
    K = camera.K.clone()
    K[0, 2] += 32
    wider = replace(camera, K=K, width=camera.width + 32)
    once = compute_source_ids(depth, camera, camera, GRID, GRID).reshape(48, 21, 3)
    moved = compute_source_ids(depth, camera, wider, GRID, (6, 10)).reshape(48, 21, 3)
    assert_close(moved, once + torch.tensor([0.0, 0.0, 2.0]), "positions")


def test_what_lies_behind_the_target_is_finite_and_far_outside_of_its_image():
    camera, depth = centred_camera(), torch.full(SIZE, 2.0)
    c2w = torch.eye(4)
    c2w[2, 3] = 5.0
    found = compute_source_ids(depth, camera, replace(camera, c2w=c2w), GRID, GRID)
    assert found.isfinite().all()
    outside = (found[:, 1:3] < 0) | (found[:, 1:3] > max(GRID))
    assert outside.any(dim=-1).all()


def test_cells_follow_their_quarter():
    """The cells of one token, numbered row by row over the 4 x 4."""
    cells = torch.arange(16.0).reshape(4, 4, 1).expand(4, 4, 3)
    order = pack_cells(cells.contiguous(), 4).reshape(16, 3)[:, 0].int().tolist()
    assert order == [0, 1, 4, 5, 2, 3, 6, 7, 8, 9, 12, 13, 10, 11, 14, 15]


def test_every_position_of_a_token_is_used_and_the_token_itself_by_each_group():
    assert len(POSITION_OF_HEAD) == 24
    assert set(POSITION_OF_HEAD) == set(range(sum(factor**2 for factor in LEVELS)))
    assert POSITION_OF_HEAD.count(0) == 4


def test_the_rotary_tables_are_the_authors():
    cosines, sines = PerHeadRotary((4, 6, 6))(levels_of(TINY, "source_ids_{}"))
    assert len(cosines) == len(sines) == 1
    assert_close(cosines[0].flatten(1), TINY["source_cos"], "source_cos")
    assert_close(sines[0].flatten(1), TINY["source_sin"], "source_sin")


def test_each_image_of_a_batch_has_tables_of_its_own():
    ids, rotary = levels_of(TINY, "source_ids_{}"), PerHeadRotary((4, 6, 6))
    together = rotary(torch.cat([ids, ids + 3], dim=-1))
    for table, alone, shifted in zip(together, rotary(ids), rotary(ids + 3), strict=True):
        assert_close(table, torch.cat([alone, shifted]), "table")
        assert (alone - shifted).abs().max() > 0.1


@pytest.fixture(scope="module")
def tiny_transformer():
    diffusers = pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    tiny = json.loads((STORED / "tiny_config.json").read_text())
    transformer = diffusers.FluxTransformer2DModel(**tiny["config"]).eval()
    shapes = {key: list(value.shape) for key, value in transformer.state_dict().items()}
    assert shapes == {key: shape for key, (shape, _) in tiny["keys"].items()}
    weights = {key: rule_v1(key, torch.Size(shape)) for key, shape in shapes.items()}
    transformer.load_state_dict(weights, strict=True)
    return enable_per_head_positions(transformer)


def repeated(level_0: torch.Tensor) -> torch.Tensor:
    """Repeat level 0 for all levels, as in plain FLUX."""
    return level_0.repeat(1, 21)


def cases() -> dict[str, torch.Tensor]:
    target, source = levels_of(TINY, "target_ids_{}"), levels_of(TINY, "source_ids_{}")
    zeros, ones = torch.zeros(48, 1), torch.ones(48, 1)
    plain_target = repeated(torch.cat([zeros, plain_ids()], dim=1))
    plain_source = repeated(torch.cat([ones, plain_ids()], dim=1))
    return {
        "out_multiscale": torch.cat([target, source]),
        "out_multiscale_bf16ids": torch.cat([target.bfloat16().float(), source]),
        "out_plain": torch.cat([plain_target, plain_source]),
        "out_mixed4": torch.cat([plain_target, source]),
    }


@pytest.mark.parametrize("name", cases())
def test_the_transformer_gives_the_authors_numbers(tiny_transformer, name):
    with torch.inference_mode():
        (found,) = tiny_transformer(
            hidden_states=TINY["hidden_states"],
            encoder_hidden_states=TINY["encoder_hidden_states"],
            pooled_projections=TINY["pooled"],
            timestep=TINY["timestep"],
            guidance=TINY["guidance"],
            img_ids=cases()[name],
            txt_ids=torch.zeros(512, 63),
            return_dict=False,
        )
    assert_close(found, TINY[name], name)


def test_every_published_tensor_fits_the_transformer_of_diffusers():
    diffusers = pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    published = json.loads((STORED / "keys.json").read_text())
    with torch.device("meta"):
        transformer = diffusers.FluxTransformer2DModel(**PE_FIELD_TRANSFORMER)
    enable_per_head_positions(transformer)
    shapes = {key: list(value.shape) for key, value in transformer.state_dict().items()}
    assert len(shapes) == 1160
    assert shapes == published["keys"]
    assert 2 * sum(p.numel() for p in transformer.parameters()) == published["index_total_size"]


def test_a_transformer_of_other_heads_is_refused():
    diffusers = pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    config = json.loads((STORED / "tiny_config.json").read_text())["config"]
    config["num_attention_heads"] = 12
    with pytest.raises(ValueError, match="24 heads, got 12"):
        enable_per_head_positions(diffusers.FluxTransformer2DModel(**config))


def test_the_gpu_of_a_mac_gets_angles_of_32_bits_that_are_as_good(monkeypatch):
    """It has no others."""
    assert rotary.choose_angle_dtype(torch.device("mps")) is torch.float32
    assert rotary.choose_angle_dtype(torch.device("cuda")) is torch.float64
    ids = compute_target_ids((1024, 1024), (64, 64), torch.float32)
    exact = PerHeadRotary((16, 56, 56))(ids)
    monkeypatch.setattr(rotary, "choose_angle_dtype", lambda device: torch.float32)
    for found, true in zip(PerHeadRotary((16, 56, 56))(ids), exact, strict=True):
        assert (found - true).abs().max() < 1e-4 * true.abs().max()
