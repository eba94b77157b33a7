"""Odd values in calls of the Python interface, and mutated files in its readers.

python tests/support/fuzz_python.py --calls 3000 --files 5000 --seed 0

All in one process, so that thousands take minutes; `fuzz.py` runs whole commands instead. A finding
is any exception but InputError, a warning of NumPy, a sentence of several lines, a call of more
than 20 s of the processor, and a silent wrong result: something was accepted, and what comes out is
not finite, out of range, cannot be written and read again, or a value that was given has changed.
`--only NAME:NUMBER` repeats one.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import torch
from jaxtyping import config as jaxtyping_config

import fuzz as commands
import gscompleter as gsc
from fuzz import Outcome
from gscompleter.data.formats import open_photographs
from gscompleter.generators import GeneratorOutput
from gscompleter.numerics.value_checks import check_gaussians, check_views
from gscompleter.types import DepthMap, Reconstruction, View
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of
from splat_files import SPLAT_FILES, WRITTEN

jaxtyping_config.update("jaxtyping_disable", True)  # users run without it

SIZE = 32
SECONDS = 20
"""Longest call, in seconds of the processor: a busy machine is no fault."""
ADDRESS_SPACE = 8 << 30
NAN, INF = float("nan"), float("inf")
NUMBERS = [0.0, -1.0, 1.0, 2.0, 0.5, 1e-30, 1e20, -1e20, 1e38, 3e5, NAN, INF, -INF]
ODD: list[Any] = [
    *(None, True, 0, -1, 3, 64.5, 10**6, 2**63, NAN, INF, "", "a", "1", b"a", (), (1, 2)),
    *([], {}, object(), np.zeros(3, np.float32), np.eye(4), np.float32(2), np.int64(7)),
    *(torch.zeros(()), torch.eye(4), torch.zeros(0, 3), Path("/absent"), int, gsc.Gaussians),
]


Call = Callable[[random.Random, Path], None]
"""One call with odd values, in an empty folder; an AssertionError is a silent wrong result."""


# ---- odd values ---------------------------------------------------------------------------------


def spoil_tensor(tensor: torch.Tensor, chance: random.Random) -> Any:
    """Change a tensor: its numbers, shape, dtype, device or kind; or replace it."""
    changed = tensor.clone()
    kind = chance.choice(["number", "number", "number", "row", "shape", "kind", "dtype", "odd"])
    if kind in ("number", "row") and changed.numel() > 0:
        flat = changed.view(-1)
        count = 1 if kind == "number" else max(1, flat.numel() // 3)
        start = chance.randrange(flat.numel())
        value = chance.choice(NUMBERS)
        if changed.is_floating_point():
            flat[start : start + count] = value
        else:
            flat[start : start + count] = chance.choice([0, 1])
        return changed
    if kind == "shape":
        makers = [
            lambda t: t[..., :-1],
            lambda t: t[1:],
            lambda t: t[None],
            lambda t: t.flatten(),
            lambda t: t.mT if t.dim() > 1 else t[:, None],
            lambda t: torch.cat([t, t]),
            lambda t: t[:0],
            lambda t: t[..., None],
        ]
        return chance.choice(makers)(changed) if changed.dim() > 0 else changed[None]
    if kind == "dtype":
        dtypes = [torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8]
        return changed.to(chance.choice([*dtypes, torch.bool, torch.complex64]))
    if kind == "kind":
        makers = [
            lambda t: t.numpy(),
            lambda t: t.tolist(),
            lambda t: t.to("meta"),
            lambda t: t.to_sparse(),
            lambda t: t.float().requires_grad_(),
            lambda t: t.flip(0).as_strided(t.shape, t.stride()) if t.dim() else t,
            lambda t: t[..., :1].expand(t.shape) if t.dim() else t,
        ]
        return chance.choice(makers)(changed)
    return chance.choice(ODD)


def spoil(value: Any, chance: random.Random) -> Any:
    """Return a copy of a dataclass with one odd part, or an odd value in its place."""
    if chance.random() < 0.05:
        return chance.choice(ODD)
    name = chance.choice([field.name for field in fields(value) if field.init])
    part = getattr(value, name)
    if isinstance(part, torch.Tensor):
        part = spoil_tensor(part, chance)
    elif isinstance(part, gsc.Camera | gsc.Gaussians | DepthMap) and chance.random() < 0.7:
        part = spoil(part, chance)
    elif isinstance(part, tuple) and part and chance.random() < 0.7:
        parts = list(part)
        index = chance.randrange(len(parts))
        choice = chance.random()
        if choice < 0.3:
            del parts[index]
        elif choice < 0.5:
            parts.append(parts[index])
        else:
            is_value = is_dataclass(parts[index])
            parts[index] = spoil(parts[index], chance) if is_value else chance.choice(ODD)
        part = tuple(parts)
    else:
        part = chance.choice([*ODD, *NUMBERS])
    return replace(value, **{name: part})


def spoil_numbers(gaussians: gsc.Gaussians, chance: random.Random) -> gsc.Gaussians:
    """Write odd numbers into a property."""
    name = chance.choice(["means", "quats", "scales", "opacities", "sh"])
    part = getattr(gaussians, name).clone()
    flat = part.view(-1)
    for _ in range(chance.choice([1, 1, 3, 40])):
        flat[chance.randrange(flat.numel())] = chance.choice(NUMBERS)
    return replace(gaussians, **{name: part})


# ---- scenes, and models of users ----------------------------------------------------------------

VIEWS = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, 0.1)]
TARGET = camera_at(0.7, size=SIZE, yaw=12)
SCENE = gaussians_of(VIEWS[0])


def copy_view(view: View) -> View:
    return replace(view, image=view.image.clone())


def reconstruct(views: list[View]) -> Reconstruction:
    """Reconstruct a room whose true depth is known."""
    truths = [view_of(Room(), view.camera) for view in views]
    counts = torch.tensor([truth.depth.numel() for truth in truths])
    return Reconstruction(
        gsc.merge([gaussians_of(truth) for truth in truths]),
        tuple(DepthMap(truth.depth, truth.depth > 0) for truth in truths),
        torch.arange(len(views)).repeat_interleave(counts),
        torch.cat([torch.arange(count) for count in counts.tolist()]),
        torch.ones(len(views), 3),
    )


def paint(nearest: View, target: gsc.Camera, context: Any) -> torch.Tensor:
    return torch.full((target.height, target.width, 3), 0.5)


class Batch:
    """A generator with settings and an answer of its own."""

    def __init__(self, chance: random.Random) -> None:
        self.supports_padding = chance.choice([True, False])
        self.max_batch_size = chance.choice([1, 2, *ODD])
        self.chance = chance

    def synthesize(self, requests: Any) -> Any:
        images = [paint(r.nearest, r.target, r.context) for r in requests]
        made = [GeneratorOutput(image) for image in images]
        answers = [made, made[1:], made + made, images, tuple(made), None, [None] * len(made)]
        return self.chance.choice(answers)


def check_scene(scene: gsc.Gaussians) -> None:
    """Fail unless the Gaussians are those that a file can hold."""
    assert isinstance(scene, gsc.Gaussians)
    try:
        check_gaussians(scene, "A result")
    except gsc.InputError as error:
        raise AssertionError(f"silent: {error}") from None


def check_completion(done: gsc.Completion) -> None:
    check_scene(done.scene)
    for result in done.targets:
        for render in (result.before, result.after):
            for image in (render.image, render.depth, render.alpha):
                assert bool(image.isfinite().all()), "silent: a render is not finite"
        assert 0 <= result.hole_fraction <= 1
        if not result.skip_reason:
            assert result.hole_fraction > 0.01, "silent: the hole is gone"
        else:
            assert "no hole" not in result.skip_reason, "silent: the hole is gone"


@contextmanager
def unchanged(*tensors: torch.Tensor) -> Iterator[None]:
    """Fail if a tensor that was given is written to."""
    before = [tensor.clone() for tensor in tensors]
    yield
    for old, new in zip(before, tensors, strict=True):
        assert torch.equal(old, new), "silent: a value that was given has changed"


# ---- calls --------------------------------------------------------------------------------------


def call_constructors(chance: random.Random, folder: Path) -> None:
    values = [random_gaussians(5, sh_degree=1), TARGET, VIEWS[0], reconstruct(VIEWS)]
    made = spoil(chance.choice([*values, values[3].depths[0]]), chance)
    if isinstance(made, gsc.Gaussians):
        assert len(made[:2]) == 2
        assert made.sh_degree in (0, 1, 2, 3)
        gsc.merge([made, made])
    if isinstance(made, gsc.Camera):
        assert made.z_rays().isfinite().all()
        assert made.viewmat.isfinite().all()
    if isinstance(made, View):
        assert made.static_mask.dtype is torch.bool


def call_merge(chance: random.Random, folder: Path) -> None:
    parts = [random_gaussians(3, sh_degree=chance.randrange(4)) for _ in range(2)]
    parts[0] = chance.choice([parts[0], replace(parts[0], is_antialiased=True), *ODD])
    merged = gsc.merge(chance.choice([parts, parts, (), parts[:1], parts[0]]))
    check_scene(merged)


def call_render(chance: random.Random, folder: Path) -> None:
    """Whatever can be constructed is drawn, the same each time; NaN stays visible."""
    renderer = gsc.load_renderer(chance.choice(["cpu", "cpu", "reference"]))
    scene = spoil(random_gaussians(40, sh_degree=chance.randrange(4)), chance)
    camera = spoil(TARGET, chance) if chance.random() < 0.3 else TARGET
    if not isinstance(scene, gsc.Gaussians) or not isinstance(camera, gsc.Camera):
        return
    if scene.means.dtype != camera.K.dtype or scene.means.dtype is not torch.float32:
        return
    if camera.width * camera.height > 10_000:
        return
    images = [renderer.render(scene, camera).image.detach() for _ in range(2)]
    assert torch.equal(*(image.nan_to_num() for image in images)), "silent: two draws differ"


def call_completer_with_scene(chance: random.Random, folder: Path) -> None:
    scene = chance.choice([spoil_numbers, spoil])(SCENE, chance)
    checks = chance.choice([None, None, [VIEWS[1]]])
    with unchanged(VIEWS[0].image, VIEWS[1].image):
        completer = gsc.GSCompleter(reconstructor=reconstruct, generator=paint)
        done = completer(VIEWS, TARGET, scene=scene, check_views=checks)
    check_scene(done.scene)
    if scene is not None:
        assert all(result.after.image.isfinite().all() for result in done.targets)


def call_completer_with_views(chance: random.Random, folder: Path) -> None:
    views = list(VIEWS)
    target: Any = TARGET
    if chance.random() < 0.7:
        views[chance.randrange(2)] = spoil(views[0], chance)
    else:
        target = spoil(TARGET, chance)
    arguments: dict[str, Any] = {"views": views, "target": target}
    if chance.random() < 0.2:
        arguments[chance.choice(["views", "target", "check_views"])] = chance.choice(ODD)
    done = gsc.GSCompleter(reconstructor=reconstruct, generator=paint)(**arguments)
    check_scene(done.scene)


def call_completer_settings(chance: random.Random, folder: Path) -> None:
    names = ["reconstructor", "generator", "renderer", "config", "seed"]
    settings: dict[str, Any] = {"reconstructor": reconstruct, "generator": paint}
    settings[chance.choice(names)] = chance.choice(ODD)
    completer = gsc.GSCompleter(**settings)
    if chance.random() < 0.1 and callable(completer.reconstructor):
        check_completion(completer(VIEWS, TARGET))


def call_reconstructor(chance: random.Random, folder: Path) -> None:
    def reconstruct_oddly(views: list[View]) -> Any:
        return spoil(reconstruct(views), chance)

    done = gsc.GSCompleter(reconstructor=reconstruct_oddly, generator=paint)(VIEWS, TARGET)
    check_scene(done.scene)
    assert all(result.after.image.isfinite().all() for result in done.targets)


def call_generator(chance: random.Random, folder: Path) -> None:
    views = [copy_view(view) for view in VIEWS]

    def paint_oddly(nearest: View, target: gsc.Camera, context: Any) -> Any:
        image = paint(nearest, target, context)
        kind = chance.choice(["image", "image", "output", "write", "odd"])
        if kind == "write":
            held = chance.choice([nearest.image, context.target_render.image])
            if chance.random() < 0.5:
                held.mul_(0.5)
            else:
                held.numpy()[:] = 0.25
        if kind == "output":
            return spoil(GeneratorOutput(image, notes=("A note.",)), chance)
        return chance.choice(ODD) if kind == "odd" else spoil_tensor(image, chance)

    generator = chance.choice([paint_oddly, paint_oddly, Batch(chance)])
    done = gsc.GSCompleter(reconstructor=reconstruct, generator=generator)(views, TARGET)
    check_completion(done)


WRITTEN_ENDINGS = tuple(name.partition(".")[2] for name in WRITTEN)
OTHER_ENDINGS = ("txt", "ksplat")


def call_files(chance: random.Random, folder: Path) -> None:
    """Write Gaussians with odd numbers in every format, and read them again."""
    scene = random_gaussians(60, sh_degree=chance.randrange(4))
    path = folder / f"scene.{chance.choice([*WRITTEN_ENDINGS, *OTHER_ENDINGS])}"
    odd = chance.choice([spoil_numbers, spoil_numbers, spoil])(scene, chance)
    write = chance.choice([gsc.save_splat, gsc.save_splat, gsc.save_ply])
    write(chance.choice([path, str(path)]), odd)
    loaded = gsc.load_ply(path) if write is gsc.save_ply else gsc.load_splat(path)
    check_scene(loaded)
    assert len(loaded) == len(odd), "silent: Gaussians are lost"
    gsc.save_splat(folder / "again.ply", loaded)
    check_scene(gsc.load_splat(folder / "again.ply"))


def call_loaders(chance: random.Random, folder: Path) -> None:
    """Odd arguments of the functions that load something by its name or path."""
    odd = chance.choice(ODD)
    scene = BASE / "scene" if BASE else folder
    calls: list[Callable[[], Any]] = [
        lambda: gsc.load_splat(odd),
        lambda: gsc.load_ply(odd),
        lambda: gsc.load_views(odd),
        lambda: gsc.load_views(scene, frames=odd),
        lambda: gsc.load_views(scene, frames=[odd]),
        lambda: gsc.load_views(scene, resolution=odd),
        lambda: gsc.load_views(scene, near=odd),
        lambda: gsc.load_views(scene, near=0.1, far=odd),
        lambda: gsc.load_camera(scene, frame=odd),
        lambda: gsc.load_cameras(odd),
        lambda: gsc.load_renderer(odd),
        lambda: gsc.load_generator(odd),
        lambda: gsc.load_reconstructor(odd),
        lambda: gsc.load_config(odd),
        lambda: gsc.save_splat(odd, random_gaussians(3)),
        lambda: gsc.save_splat(folder / "a.ply", odd),
        lambda: gsc.save_ply(folder / "a.ply", odd),
    ]
    made = chance.choice(calls)()
    if isinstance(made, list) and made and isinstance(made[0], View):
        check_views(made, "context")


CALLS: dict[str, Call] = {
    "constructors": call_constructors,
    "merge": call_merge,
    "render": call_render,
    "scene": call_completer_with_scene,
    "views": call_completer_with_views,
    "settings": call_completer_settings,
    "reconstructor": call_reconstructor,
    "generator": call_generator,
    "write": call_files,
    "load": call_loaders,
}


# ---- files --------------------------------------------------------------------------------------

BASE: Path | None = None
"""Folder with one valid input of every kind; set by `main`."""


def read_splat(name: str) -> Callable[[Path, random.Random], None]:
    """Read a splat, and write and read what was accepted in another format."""

    def read(folder: Path, chance: random.Random) -> None:
        loaded = gsc.load_splat(folder / name, drop_nonfinite=chance.random() < 0.3)
        check_scene(loaded)
        out = folder / f"converted.{chance.choice(WRITTEN_ENDINGS)}"
        gsc.save_splat(out, loaded)
        check_scene(gsc.load_splat(out))

    return read


def read_scene(name: str) -> Callable[[Path, random.Random], None]:
    """Open photographs with cameras, and read the first and the last."""

    def read(folder: Path, chance: random.Random) -> None:
        photographs = open_photographs(folder / name)
        frames = sorted({0, len(photographs) - 1})
        check_views(photographs.views(frames, (SIZE, SIZE)), "context")

    return read


def read_cameras(name: str) -> Callable[[Path, random.Random], None]:
    def read(folder: Path, chance: random.Random) -> None:
        for camera in gsc.load_cameras(folder / name, resolution=(SIZE, SIZE)):
            assert camera.z_rays().isfinite().all(), "silent: rays are not finite"

    return read


Reader = tuple[str, Callable[[Path, random.Random], None]]
FILES: dict[str, Reader] = {
    "ply": ("small.ply", read_splat("small.ply")),
    "ascii-ply": ("ascii.ply", read_splat("ascii.ply")),
    **{
        f"splat-{name}": (commands.name_splat(name), read_splat(f"splats/{name}"))
        for name in SPLAT_FILES
    },
    "filtered-ply": ("filtered.ply", read_splat("filtered.ply")),
    "surfels": ("surfels.ply", read_splat("surfels.ply")),
    "transforms": ("scene/transforms.json", read_scene("scene")),
    "image": ("scene/1.png", read_scene("scene")),
    "depth": ("scene/1.npy", read_scene("scene")),
    "colmap-binary": ("colmap-binary/sparse/0/*.bin", read_scene("colmap-binary")),
    "colmap-text": ("colmap-text/sparse/*.txt", read_scene("colmap-text")),
    "cameras-json": ("cameras-json/cameras.json", read_scene("cameras-json")),
    "llff": ("llff/poses_bounds.npy", read_scene("llff")),
    "kitti": ("kitti/*.txt", read_scene("kitti")),
    "dgp": ("dgp/**/*.json", read_scene("dgp")),
    "polycam": ("polycam/keyframes/*/*2.*", read_scene("polycam")),
    "scanner-app": ("scanner-app/*_00002.*", read_scene("scanner-app")),
    "record3d": ("record3d/**/*[2at]*", read_scene("record3d")),
    "record3d-zip": ("record3d.r3d", read_scene("record3d.r3d")),
    "polycam-zip": ("polycam.zip", read_scene("polycam.zip")),
    "chunk": ("chunks/000000.torch", read_scene("chunks")),
    "clip": ("clips/room.txt", read_scene("clips/room.txt")),
    "photographs": ("photographs/images/*", read_scene("photographs")),
    "infos": ("infos/infos.pkl", read_scene("infos/infos.pkl")),
    "camera": ("target.json", read_cameras("target.json")),
    "camera-list": ("target-list.json", read_cameras("target-list.json")),
    "camera-colmap": (
        "colmap-text/sparse/images.txt",
        read_cameras("colmap-text/sparse/images.txt"),
    ),
}


def run_file(kind: str, chance: random.Random) -> None:
    """Damage a file of the base, read it, and put the file back."""
    assert BASE is not None
    pattern, read = FILES[kind]
    file = chance.choice(sorted(path for path in BASE.glob(pattern) if path.is_file()))
    before = file.read_bytes()
    try:
        if file.suffix == ".json" and chance.random() < 0.7:
            content = json.loads(before)
            for _ in range(chance.choice([1, 1, 2])):
                content = commands.replaced(content, chance)
            sys.set_int_max_str_digits(0)
            file.write_text(json.dumps(content))
            sys.set_int_max_str_digits(4300)
        elif file.suffix == ".ply" and chance.random() < 0.6:
            file.write_bytes(spoil_floats(before, chance))
        else:
            commands.damage(file, chance)
        read(BASE, chance)
    finally:
        file.write_bytes(before)
        for made in BASE.glob("converted.*"):
            made.unlink()


def spoil_floats(data: bytes, chance: random.Random) -> bytes:
    """Write odd numbers into the rows of a .ply."""
    changed = bytearray(data)
    start = data.index(b"end_header\n") + 11
    for _ in range(chance.choice([1, 1, 5, 50])):
        at = start + 4 * chance.randrange(max(1, (len(data) - start) // 4))
        changed[at : at + 4] = np.float32(chance.choice(NUMBERS)).tobytes()
    return bytes(changed[: len(data)])


def write_variants(folder: Path) -> None:
    """Write a .ply with the filter of Mip-Splatting, and one of 2DGS."""
    import plyfile

    gsc.save_ply(folder / "plain.ply", random_gaussians(40, sh_degree=1))
    rows = plyfile.PlyData.read(str(folder / "plain.ply"))["vertex"].data
    kept = [column for column in rows.dtype.descr if column[0] != "scale_2"]
    variants = {
        "filtered.ply": [*rows.dtype.descr, ("filter_3D", "<f4")],
        "surfels.ply": kept,
    }
    for name, dtype in variants.items():
        made = np.zeros(len(rows), dtype)
        for column, _ in dtype:
            made[column] = 0.02 if column == "filter_3D" else rows[column]
        element = plyfile.PlyElement.describe(made, "vertex")
        plyfile.PlyData([element], byte_order="<").write(str(folder / name))


# ---- how it is run ------------------------------------------------------------------------------


class TooSlow(BaseException):
    """A call took longer than its limit; no `except Exception` catches it."""


def raise_too_slow(*_: object) -> None:
    raise TooSlow


def run(name: str, work: Callable[[], None]) -> Outcome:
    """Run one call, and describe its problem if it has one."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            work()
        return Outcome(name, False, None)
    except gsc.InputError as error:
        lines = str(error)
        is_sentence = "\n" not in lines and 0 < len(lines) <= 300
        return Outcome(name, True, None if is_sentence else f"no sentence: {lines[:80]!r}")
    except TooSlow:
        return Outcome(name, False, f"takes more than {SECONDS} s")
    except Exception as error:
        places = [
            f"{Path(frame.filename).name}:{frame.lineno}"
            for frame in traceback.extract_tb(error.__traceback__)
            if "gscompleter" in frame.filename
        ]
        where = places[-1] if places else "?"
        text = " ".join(str(error).split())[:110]
        return Outcome(name, False, f"{type(error).__name__} at {where}: {text}")
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def run_all(calls: int, files: int, seed: int, only: str | None = None) -> list[Outcome]:
    """Run the numbers of calls and of files, each kind in turn."""
    global BASE
    signal.signal(signal.SIGPROF, raise_too_slow)
    outcomes: list[Outcome] = []
    kinds = [*CALLS], [*FILES]
    chosen = [(kinds[0][i % len(CALLS)], i) for i in range(calls)]
    chosen += [(kinds[1][i % len(FILES)], i) for i in range(files)]
    if only is not None:
        kind, number = only.split(":")
        chosen = [(kind, int(number))]
    with tempfile.TemporaryDirectory() as name:
        BASE = Path(name, "base")
        BASE.mkdir()
        commands.build(BASE)
        write_variants(BASE)
        for kind, number in chosen:
            chance = random.Random(f"{seed} {kind} {number}")
            with tempfile.TemporaryDirectory(dir=name) as folder:
                if kind in CALLS:
                    work = lambda: CALLS[kind](chance, Path(folder))  # noqa: B023, E731
                else:
                    work = lambda: run_file(kind, chance)  # noqa: B023, E731
                outcomes.append(run(f"{kind}:{number}", work))
            if only is not None:
                work_again(kind, number, seed, Path(name))
    return outcomes


def work_again(kind: str, number: int, seed: int, folder: Path) -> None:
    """Repeat a call with its traceback."""
    chance = random.Random(f"{seed} {kind} {number}")
    try:
        CALLS[kind](chance, folder) if kind in CALLS else run_file(kind, chance)
    except Exception:
        traceback.print_exc()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=int(os.environ.get("FUZZ_CALLS", "3000")))
    parser.add_argument("--files", type=int, default=int(os.environ.get("FUZZ_FILES", "5000")))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="KIND:NUMBER, as a finding names it")
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    start = time.monotonic()
    outcomes = run_all(given.calls, given.files, given.seed, given.only)
    found = commands.print_findings(outcomes, "inputs", time.monotonic() - start)
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
