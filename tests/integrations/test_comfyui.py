"""The nodes of ComfyUI, called as ComfyUI does: its tensor layouts, in inference mode."""

from __future__ import annotations

import asyncio
import importlib.util
import inspect
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

import gscompleter as gsc
from command import run
from gscompleter.data.formats import open_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.splats.edits import read_edits
from gscompleter.splats.formats import read_provenance
from paths import ROOT
from scenes import Room, camera_at, gaussians_of, labelled, photographed, view_of

PACKAGE = ROOT / "integrations" / "comfyui"
SIZE = 64
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.3, 0.0, 0.3)]
TARGET = camera_at(x=0.8, z=0.5, yaw=25, size=SIZE)
MAGENTA = torch.tensor([1.0, 0.0, 1.0])
MARK = torch.zeros(1, SIZE, SIZE)
MARK[:, 26:38, 30:44] = 1.0
"""A mask in the middle of the splat alone."""


def load_nodes():
    """Import the folder as ComfyUI imports a custom node."""
    place = PACKAGE / "__init__.py"
    spec = importlib.util.spec_from_file_location(
        "comfyui_nodes", place, submodule_search_locations=[str(PACKAGE)]
    )
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


NODES = load_nodes()


def call(name, **inputs):
    """Call a node's function as the executor does."""
    node = NODES.NODE_CLASS_MAPPINGS[name]
    with torch.inference_mode():
        return getattr(node(), node.FUNCTION)(**inputs)


def paint(image, mask):
    """Paint the holes of a batch magenta, as a node between both does."""
    with torch.inference_mode():
        return torch.where(mask[..., None] > 0.5, MAGENTA, image)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = photographed(tmp_path_factory.mktemp("comfyui") / "scene", CAMERAS)
    write_cameras(folder / "target.json", [CAMERAS[1], TARGET])
    return folder


def find(scene, **more):
    target = {"target": str(scene / "target.json"), "camera": 1}
    inputs = {"scene": str(scene), "context": "0, 2", "height": SIZE, "width": SIZE, **target}
    return call("GSCompleterFindHoles", **{**inputs, **more})


@pytest.fixture(scope="module")
def found(scene):
    return find(scene)


def test_the_holes_come_in_the_layouts_of_comfyui(found):
    image, mask, _, warped, reference, depth = found
    assert image.shape == (1, SIZE, SIZE, 3)
    assert mask.shape == (1, SIZE, SIZE)
    assert (image.dtype, mask.dtype) == (torch.float32, torch.float32)
    assert image.min() >= 0
    assert image.max() <= 1
    assert set(mask.unique().tolist()) == {0.0, 1.0}
    truth = view_of(Room(), TARGET).image
    error = (image[0] - truth).abs().mean(dim=-1)
    assert error[mask[0] == 0].median() < 0.3 * error[mask[0] == 1].median()

    # For models that take more than an image and a mask.
    for more in (warped, reference, depth):
        assert (more.shape, more.dtype) == ((1, SIZE, SIZE, 3), torch.float32)
    assert (warped[0] - truth).abs()[mask[0] == 0].median() < 0.05
    differences = [(reference[0] - view_of(Room(), camera).image).abs() for camera in CAMERAS]
    assert min(difference.max() for difference in differences) < 0.01
    assert depth.max() == 1
    assert depth[0][mask[0] == 1].median() == 0


def test_the_painted_image_ends_in_the_splat(found, tmp_path):
    image, mask, holes, *_ = found
    (path,) = call(
        "GSCompleterRegisterPainting", holes=holes, image=paint(image, mask), out=str(tmp_path)
    )
    scene = gsc.load_splat(path)
    generated = scene[scene.generated > 0]
    assert len(generated) > 0.3 * mask.sum()
    inside = mask[0] == 1
    shown = gsc.load_renderer("cpu").render(scene, holes.target).image
    assert (shown - MAGENTA).abs()[inside].mean() < 0.1
    assert (shown - image[0]).abs()[~inside].mean() < 0.05
    summary = json.loads((Path(path).parent / "summary.json").read_text())
    assert summary["painter"] == "ComfyUI"
    assert summary["target_id"] == 1
    assert summary["added"] == len(generated)
    assert sorted(file.name for file in Path(path).parent.iterdir()) == [
        *("after.png", "before.png", "completed.ply", "context.ply", "edits.json"),
        *("generated.ply", "painted.png", "summary.json"),
    ]


# `test_the_painted_image_ends_in_the_splat` and the next test register one painting each.
@pytest.mark.slow
def test_each_painting_gets_its_folder_and_may_be_larger(found, tmp_path):
    image, mask, holes, *_ = found
    large = paint(image, mask).repeat_interleave(2, dim=1).repeat_interleave(2, dim=2)
    results = [
        call("GSCompleterRegisterPainting", holes=holes, image=batch, out=str(tmp_path))[0]
        for batch in (paint(image, mask), torch.cat([large, 0 * large]))
    ]
    assert [Path(path).parent.name for path in results] == ["00001", "00002"]
    small, scaled = map(gsc.load_splat, results)
    assert (small.sh[-1] - scaled.sh[-1]).abs().max() < 0.2 * small.sh[-1].abs().max()


# `test_the_painted_image_ends_in_the_splat` paints as well.
@pytest.mark.slow
def test_a_layer_with_the_filling_alone_is_enough(found, tmp_path):
    """Its fourth channel is alpha, and what it does not cover is the scene."""
    image, mask, holes, *_ = found
    layer = torch.cat([MAGENTA.expand_as(image) * mask[..., None], mask[..., None]], dim=-1)
    inputs = {"holes": holes, "image": layer, "out": str(tmp_path), "painter": "a person"}
    (path,) = call("GSCompleterRegisterPainting", **inputs)
    shown = gsc.load_renderer("cpu").render(gsc.load_splat(path), holes.target).image
    assert (shown - MAGENTA).abs()[mask[0] == 1].mean() < 0.1
    assert (shown - image[0]).abs()[mask[0] == 0].mean() < 0.05
    summary = json.loads((Path(path).parent / "summary.json").read_text())
    assert summary["painter"] == "a person"
    assert summary["notes"] == []


# `tests/trust/test_photometric.py` strips the result of a command.
@pytest.mark.slow
def test_a_splat_keeps_its_bytes(scene, tmp_path, monkeypatch):
    seen = [gaussians_of(view_of(Room(), camera)) for camera in CAMERAS[::2]]
    splat = labelled(tmp_path / "splat.ply", gsc.merge(seen))
    image, mask, holes, *_ = find(scene, splat=str(splat))
    (path,) = call(
        "GSCompleterRegisterPainting", holes=holes, image=paint(image, mask), out=str(tmp_path)
    )
    assert (gsc.load_splat(path).generated > 0).sum() > 0.3 * mask.sum()
    assert run(monkeypatch, "strip", path, "--out", tmp_path / "back.ply") == 0
    assert (tmp_path / "back.ply").read_bytes() == splat.read_bytes()


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """Return a splat of one photograph, with a camera beside that of the photograph."""
    folder = tmp_path_factory.mktemp("alone")
    gsc.save_ply(folder / "splat.ply", gaussians_of(view_of(Room(), camera_at(size=SIZE))))
    write_cameras(folder / "camera.json", [camera_at(0.02, size=SIZE)])
    write_cameras(folder / "away.json", [camera_at(0.4, size=SIZE)])
    return folder


def find_alone(splat, target):
    """Find the hole of a splat without photographs."""
    inputs = {"splat": str(splat), "target": str(target), "height": SIZE, "width": SIZE}
    return call("GSCompleterFindHoles", scene="", context="", **inputs)


def test_a_splat_alone_is_shown_and_its_holes_are_found(alone):
    inputs = {"splat": str(alone / "splat.ply"), "height": SIZE, "width": SIZE}
    (image,) = call("GSCompleterShowSplat", target=str(alone / "camera.json"), **inputs)
    truth = view_of(Room(), camera_at(0.02, size=SIZE)).image
    other = view_of(Room(), camera_at(0.3, size=SIZE)).image
    assert image.shape == (1, SIZE, SIZE, 3)
    assert (image[0] - truth).abs().mean() < 0.5 * (image[0] - other).abs().mean()
    with pytest.raises(gsc.InputError, match="has 1 cameras"):
        call("GSCompleterShowSplat", target=str(alone / "camera.json"), **inputs, camera=1)
    away = find_alone(alone / "splat.ply", alone / "away.json")
    assert 0.02 < away[1].mean() < 0.5
    assert away[2].ready.opened.renders_from == "targets"


@pytest.mark.slow
def test_targets_are_searched_for_and_photographs_chosen(scene):
    _, mask, holes, *_ = find(scene, context="", target="", camera=0)
    assert len(holes.ready.task.targets) == 1
    assert len(holes.state.views) >= 2
    assert mask.sum() > 0


def repair(alone: Path, out: Path) -> tuple[str, torch.Tensor]:
    """Repair what a mask marks in a splat, and return the result and its image."""
    inputs = {"target": str(alone / "camera.json"), "out": str(out), "mask": MARK}
    return call("GSCompleterRepair", splat=str(alone / "splat.ply"), **inputs)


def test_a_painted_mask_is_repaired(alone, tmp_path):
    first, after = repair(alone, tmp_path)
    assert after.shape == (1, SIZE, SIZE, 3)
    given = {"splat": str(alone / "splat.ply"), "target": str(alone / "camera.json")}
    (before,) = call("GSCompleterShowSplat", **given, height=SIZE, width=SIZE)
    assert (after - before).abs()[MARK == 0].mean() < 0.02
    assert (after - before).abs()[MARK == 1].max() > 0.1
    assert gsc.load_splat(first).generated.any()


# The tests before repair, and register a painting; `test_undo.py` takes edits off one by one.
@pytest.mark.slow
def test_a_painting_on_top_of_a_repair_is_a_second_edit(alone, tmp_path, monkeypatch):
    first, _ = repair(alone, tmp_path)
    image, asked, holes, *_ = find_alone(first, alone / "away.json")
    painted = {"holes": holes, "image": paint(image, asked), "out": str(tmp_path)}
    (second,) = call("GSCompleterRegisterPainting", **painted)
    assert [edit.command for edit in read_edits(Path(second)).edits] == ["repair", "complete"]
    assert len(read_provenance(Path(second)).runs) == 2
    for word, given in (("--last", Path(first)), (None, alone / "splat.ply")):
        back = tmp_path / "back.ply"
        words = ["strip", second, "--out", back, "--overwrite", *filter(None, [word])]
        assert run(monkeypatch, *words) == 0
        assert back.read_bytes() == given.read_bytes()


def test_a_mask_of_nothing_gets_a_sentence(alone, tmp_path):
    inputs = {"target": str(alone / "camera.json"), "out": str(tmp_path)}
    mask = torch.zeros(1, SIZE, SIZE)
    with pytest.raises(gsc.InputError, match=r"mask\.png is black everywhere"):
        call("GSCompleterRepair", splat=str(alone / "splat.ply"), mask=mask, **inputs)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ({"context": "left right"}, "no photograph 'left'"),
        ({"context": "0 9"}, "9"),
        ({"camera": 2}, "has 2 cameras"),
        ({"target": "nowhere.json"}, "nowhere.json"),
    ],
)
def test_wrong_inputs_get_a_sentence(scene, more, sentence):
    with pytest.raises(gsc.InputError, match=sentence):
        find(scene, **more)


def test_photographs_are_named_by_their_files(scene, found):
    name = open_photographs(scene).frame(0).file_name
    image, mask, *_ = find(scene, context=f"{name} 2")
    assert torch.equal(image, found[0])
    assert torch.equal(mask, found[1])


def test_masks_are_checked_as_the_commands_do(scene, tmp_path):
    copy = Path(shutil.copytree(scene, tmp_path / "scene"))
    for frame in open_photographs(copy).frames:
        pixels = Image.new("L", (SIZE, SIZE))  # black: what is ignored
        pixels.paste(255, (0, 0, SIZE, SIZE // 4))
        (copy / "masks").mkdir(exist_ok=True)
        pixels.save(copy / "masks" / f"{Path(frame.file_name).stem}.png")
    with pytest.raises(gsc.InputError, match=r"Masks hide 75 % of the photographs"):
        find(copy)
    _, _, holes, *_ = find(copy, invert_masks=True)
    assert holes.state.views[0].ignore_mask.float().mean() == 0.25
    with pytest.raises(gsc.InputError, match="No mask is used"):
        find(scene, invert_masks=True)


def test_wrong_paintings_get_a_sentence_and_write_nothing(found, tmp_path):
    image, _, holes, *_ = found
    with pytest.raises(gsc.InputError, match="same aspect ratio, without cropping"):
        call("GSCompleterRegisterPainting", holes=holes, image=image[:, :32], out=str(tmp_path))
    other = view_of(Room(), camera_at(-0.5, yaw=-20, size=SIZE)).image[None]
    with pytest.raises(gsc.InputError, match="does not show what its camera sees"):
        call("GSCompleterRegisterPainting", holes=holes, image=other, out=str(tmp_path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", NODES.NODE_CLASS_MAPPINGS)
def test_nodes_declare_what_their_functions_take(name):
    node = NODES.NODE_CLASS_MAPPINGS[name]
    groups = node.INPUT_TYPES()
    named = [key for group in groups.values() for key in group]
    function = inspect.signature(getattr(node, node.FUNCTION))
    assert ["self", *named] == list(function.parameters)
    defaults = {k for k, p in function.parameters.items() if p.default is not p.empty}
    assert defaults == set(groups.get("optional", {}))
    assert len(node.RETURN_TYPES) == len(node.RETURN_NAMES)
    assert name in NODES.NODE_DISPLAY_NAME_MAPPINGS


def test_the_registry_finds_its_fields():
    tomllib = pytest.importorskip("tomllib", reason="needs Python 3.11")
    fields = tomllib.loads((PACKAGE / "pyproject.toml").read_text())
    assert fields["project"]["name"] == "gscompleter-nodes"
    assert fields["project"]["version"] == gsc.__version__
    assert "gscompleter" in fields["project"]["dependencies"]
    assert fields["tool"]["comfy"]["DisplayName"]


def test_a_node_runs_again_when_a_file_was_written_anew(tmp_path):
    node = NODES.NODE_CLASS_MAPPINGS["GSCompleterRepair"]
    file, out = tmp_path / "camera.json", tmp_path / "out"
    file.write_text("{}")
    out.mkdir()
    inputs = {"splat": "", "target": f" {file} ", "out": str(out), "large_masks": False}
    first = node.IS_CHANGED(**inputs)
    (out / "00001").mkdir()
    assert node.IS_CHANGED(**inputs) == first
    file.write_text("{ }")
    assert node.IS_CHANGED(**inputs) != first
    folder = {"scene": str(tmp_path)}
    before = node.IS_CHANGED(**folder)
    (tmp_path / "new.jpg").touch()
    assert node.IS_CHANGED(**folder) != before


class Server:
    """The page of ComfyUI, as far as its executor speaks to it."""

    client_id = last_node_id = None

    def __init__(self):
        self.sockets_metadata = {}

    def send_sync(self, event, data, client=None):
        pass


@pytest.fixture(scope="module")
def comfyui():
    """Return a function that runs a workflow in ComfyUI itself.

    It returns the nodes that did not run again.
    """
    cli_args = pytest.importorskip("comfy.cli_args", reason="needs ComfyUI on the path")
    cli_args.args.cpu = True
    import execution
    import nodes

    masks = Path(nodes.__file__).with_name("comfy_extras") / "nodes_mask.py"
    for module in (masks, PACKAGE):
        assert asyncio.run(nodes.load_custom_node(str(module)))
    executor = execution.PromptExecutor(Server(), execution.CacheType.CLASSIC, 0)

    def run_workflow(workflow):
        # The page sends it anew each time, and ComfyUI writes into what it got.
        workflow = json.loads(json.dumps(workflow))
        is_valid, error, outputs, _ = asyncio.run(execution.validate_prompt("1", workflow, None))
        assert is_valid, error
        executor.execute(workflow, "1", {}, outputs)
        events = dict(executor.status_messages)
        assert executor.success, events["execution_error"]["exception_message"]
        return events["execution_cached"]["nodes"]

    return run_workflow


@pytest.mark.slow
def test_comfyui_itself_fills_and_repairs(comfyui, scene, tmp_path):
    """Its own nodes paint between ours, and pass on images and masks."""
    target = {"target": str(scene / "target.json"), "height": SIZE, "width": SIZE}
    find = {"scene": str(scene), "context": "0, 2", "camera": 1, **target}
    write_cameras(scene / "one.json", [TARGET])
    wrong = {"target": str(scene / "one.json"), "large_masks": True}
    repaired = tmp_path / "repaired"
    composite = {"destination": ["1", 0], "source": ["1", 3], "x": 0, "y": 0}
    workflow = {
        "1": {"class_type": "GSCompleterFindHoles", "inputs": find},
        "2": {
            "class_type": "ImageCompositeMasked",
            "inputs": {**composite, "resize_source": False, "mask": ["1", 1]},
        },
        "3": {
            "class_type": "GSCompleterRegisterPainting",
            "inputs": {"holes": ["1", 2], "image": ["2", 0], "out": str(tmp_path)},
        },
        "4": {
            "class_type": "GSCompleterRepair",
            "inputs": {**wrong, "splat": ["3", 0], "mask": ["1", 1], "out": str(repaired)},
        },
        "5": {"class_type": "PreviewImage", "inputs": {"images": ["4", 1]}},
        "6": {
            "class_type": "GSCompleterShowSplat",
            "inputs": {"splat": ["4", 0], "camera": 1, **target},
        },
        "7": {"class_type": "PreviewImage", "inputs": {"images": ["6", 0]}},
    }
    assert comfyui(workflow) == []
    for folder in (tmp_path, repaired):
        result = gsc.load_splat(folder / "00001" / "completed.ply")
        assert int((result.generated > 0).sum()) > 100
    # Nothing changed, and nothing runs; then a file of cameras is written anew.
    assert len(comfyui(workflow)) == len(workflow)
    assert not (tmp_path / "00002").exists()
    write_cameras(scene / "target.json", [CAMERAS[1], TARGET])
    assert comfyui(workflow) == []
    assert (tmp_path / "00002").exists()
