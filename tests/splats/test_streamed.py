"""One level of detail of a streamed .sog."""

from __future__ import annotations

import json

import pytest
import torch

from gscompleter import InputError
from gscompleter.splats.streamed import is_streamed, load_level
from gscompleter.types import merge
from splat_files import plausible, sog_files, write_sog


@pytest.fixture
def streamed(tmp_path):
    """Write a scene of two places: the finest level of both, and a coarse one of both together."""
    places = [plausible(40), plausible(60)]
    coarse = plausible(30, degree=0)
    folder = tmp_path / "garden"
    folder.mkdir()
    for name, scene in (("0_0", places[0]), ("0_1", places[1]), ("1_0", coarse)):
        write_sog(folder / name, sog_files(scene))
    leaves = [
        {"bound": {}, "lods": {"0": {"file": i, "offset": 0, "count": len(scene)}}}
        for i, scene in enumerate(places)
    ]
    half = {"file": 2, "offset": 10, "count": 20}
    tree = {"bound": {}, "children": leaves, "lods": {"1": half}}
    files = [f"{name}/meta.json" for name in ("0_0", "0_1", "1_0")]
    index = {"lodLevels": 2, "filenames": files, "tree": tree}
    (folder / "lod-meta.json").write_text(json.dumps(index))
    return folder


def test_a_level_is_read_from_all_its_places(streamed):
    assert is_streamed(streamed)
    assert is_streamed(streamed / "lod-meta.json")
    assert not is_streamed(streamed / "0_0")
    fine = load_level(streamed, 0)
    given = merge([plausible(40), plausible(60)])
    assert len(fine) == 100
    assert (fine.means - given.means).abs().max() < 1e-3 * given.means.abs().max()
    coarse = load_level(streamed / "lod-meta.json", 1)
    assert len(coarse) == 20
    assert torch.allclose(coarse.means, plausible(30, degree=0).means[10:], atol=1e-2)


def test_what_is_not_finite_is_refused_or_dropped_from_a_level(streamed):
    """A size of e^1000 is infinite; Gaussians of the file before a part do not count."""
    meta = streamed / "1_0" / "meta.json"
    table = json.loads(meta.read_text())
    codebook = table["scales"]["codebook"]
    sizes = load_level(streamed, 1).scales.log().flatten()
    middle = sizes.median().item()
    table["scales"]["codebook"] = [1000.0 if size > middle else size for size in codebook]
    meta.write_text(json.dumps(table))
    with pytest.raises(InputError, match=r"lod-meta\.json has \d+ of 20 Gaussians with NaN"):
        load_level(streamed, 1)
    left = load_level(streamed, 1, drop_nonfinite=True)
    assert 0 < len(left) < 20
    assert left.scales.isfinite().all()


def test_a_level_that_is_not_there_is_refused(streamed):
    with pytest.raises(InputError, match="has levels 0 to 1"):
        load_level(streamed, 2)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"tree": 3}, "is no index of levels"),
        ({"lodLevels": float("inf")}, "is no index of levels"),
        ({"filenames": ["0_0/meta.json"]}, "names no Gaussians of level 0"),
        ({"filenames": ["../0_0/meta.json"] * 3}, "names a file outside of its folder"),
    ],
)
def test_a_damaged_index_is_refused(streamed, change, sentence):
    index = streamed / "lod-meta.json"
    index.write_text(json.dumps(json.loads(index.read_text()) | change))
    with pytest.raises(InputError, match=sentence):
        load_level(streamed, 0)


def test_an_index_that_promises_more_than_a_file_has_is_refused(streamed):
    table = json.loads((streamed / "lod-meta.json").read_text())
    table["tree"]["lods"]["1"]["count"] = 21
    (streamed / "lod-meta.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match="has 30 Gaussians, fewer than"):
        load_level(streamed, 1)
