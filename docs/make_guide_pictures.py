"""Make the pictures of README and guide: docs/loop.webp and docs/pictures/.

    python docs/make_guide_pictures.py FOLDER [NAME ...]

A drawn room stands for a place: its photographs, a splat that lacks what they do not show, and new
photographs. The commands of the pages run on it in FOLDER, which keeps what they write; what they
print goes to the terminal. Names are those of `PICTURES`; all are made if none is given. Needs
`pip install 'gscompleter[poses,browser]'`, and Debian's chromium for the page of a batch.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

import gscompleter as gsc
from gscompleter.data.scene import write_cameras
from gscompleter.render.loading import load_renderer
from gscompleter.splats.ply import save_ply
from gscompleter.system.files.image import write_image
from gscompleter.types import Camera, Gaussians, make_observed, merge, sh_from_rgb

SIZE = 256
"""Side of the photographs, in pixels."""
FOCAL = 0.75
"""Focal length in image widths."""
ROOM = ((-3.0, -1.5, -1.0), (3.0, 1.5, 5.0))
"""Smallest and largest corner in metres; x is right, y down."""
THINGS = {
    "crate": ((-1.9, 0.6, 3.4), (-0.9, 1.5, 4.4)),
    "shelf": ((1.0, -0.9, 4.6), (2.9, 1.5, 5.0)),
    "table": ((1.1, 0.5, 2.6), (2.2, 1.5, 3.4)),
}
"""Boxes in the room. Shelf and table stand where the old photographs do not look."""
OLD, NEW = 7, 4
"""Number of photographs that the splat was made from, and of new ones."""
SMALL = "--overwrite --resolution 192"
"""Options of runs whose pictures need less detail."""
QUALITY = 82
MAX_BYTES = 150_000
MARGIN, CAPTION = 6, 24
"""Pixels between panels, and the height of the words below."""
DOCS = Path(__file__).parent


# ------------------------------------------------------------------- the room


def draw_room(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw the image [h, w, 3] and the z-depth [h, w] of the room as a camera sees it."""
    rays, origin = camera.z_rays().double(), camera.center.double()
    depth = torch.full(rays.shape[:2], torch.inf, dtype=torch.float64)
    thing = torch.zeros(rays.shape[:2], dtype=torch.long)
    for index, (low, high) in enumerate((ROOM, *THINGS.values())):
        to_low = (torch.tensor(low, dtype=torch.float64) - origin) / rays
        to_high = (torch.tensor(high, dtype=torch.float64) - origin) / rays
        enter = torch.minimum(to_low, to_high).nan_to_num(-torch.inf).amax(-1)
        leave = torch.maximum(to_low, to_high).nan_to_num(torch.inf).amin(-1)
        # The room is seen from inside, the things from outside.
        hit = leave if index == 0 else enter.where((enter < leave) & (enter > 0), torch.inf)
        thing = thing.where(hit >= depth, torch.tensor(index))
        depth = torch.minimum(depth, hit)
    points = (origin + depth[..., None] * rays).numpy()
    return torch.from_numpy(paint(points, thing.numpy())).float(), depth.float()


def paint(points: np.ndarray, thing: np.ndarray) -> np.ndarray:
    """Paint world points [h, w, 3] by the thing that they lie on."""
    x, y, z = np.moveaxis(points, -1, 0)
    floor, ceiling = y > ROOM[1][1] - 1e-4, y < ROOM[0][1] + 1e-4
    side = np.abs(x) > ROOM[1][0] - 1e-4
    along = np.where(side, z, x)
    # Bricks, in rows that are shifted by half a brick.
    row = np.floor(y / 0.2)
    brick = np.floor(along / 0.5 + 0.5 * (row % 2))
    mortar = (np.mod(y, 0.2) < 0.018) | (np.mod(along / 0.5 + 0.5 * (row % 2), 1) < 0.036)
    tone = mix(pick(brick, row, side))
    colour = np.stack([0.60 + 0.16 * tone, 0.36 + 0.12 * tone, 0.28 + 0.10 * tone], -1)
    colour = np.where(mortar[..., None], [0.78, 0.75, 0.70], colour)
    # Planks of the floor.
    plank = mix(pick(np.floor(x / 0.22), np.floor(z / 1.1 + 0.37 * np.floor(x / 0.22))))
    wood = np.stack([0.62 + 0.2 * plank, 0.44 + 0.16 * plank, 0.26 + 0.12 * plank], -1)
    wood = np.where((np.mod(x, 0.22) < 0.012)[..., None], 0.2, wood)
    colour = np.where(floor[..., None], wood, colour)
    colour = np.where(ceiling[..., None], [0.86, 0.85, 0.82], colour)
    # A crate of boards, a shelf of books, a table with a checked cloth.
    board = mix(pick(np.floor(y / 0.15), 7.0 * np.ones_like(y)))
    crate = np.stack([0.72 + 0.14 * board, 0.58 + 0.12 * board, 0.30 + 0.10 * board], -1)
    crate = np.where((np.mod(y + 0.07, 0.15) < 0.012)[..., None], 0.15, crate)
    book = pick(np.floor(x / 0.07), np.floor(y / 0.4))
    spine = np.stack([mix(book), mix(book + 0.31), mix(book + 0.67)], -1) * 0.5 + 0.2
    spine = np.where((np.mod(y, 0.4) < 0.05)[..., None], [0.36, 0.25, 0.16], spine)
    check = (np.floor(x / 0.12) + np.floor(z / 0.12) + np.floor(y / 0.12)) % 2
    cloth = np.where(check[..., None] > 0, [0.88, 0.88, 0.84], [0.18, 0.34, 0.62])
    for index, paints in enumerate((crate, spine, cloth), start=1):
        colour = np.where((thing == index)[..., None], paints, colour)
    grain = sum(strength * make_noise(points / length) for length, strength in GRAIN)
    shade = 0.86 + 0.14 * np.clip(-y / 1.5, -1, 1) * 0.5 - 0.05 * (side & (thing == 0))
    return np.clip(colour * shade[..., None] + grain[..., None], 0, 1)


GRAIN = ((0.6, 0.10), (0.2, 0.09), (0.07, 0.07))
"""Wavelengths in metres and strengths of the noise on all surfaces, which stereo needs."""


def mix(values: np.ndarray) -> np.ndarray:
    """Turn integers into numbers in [0, 1) that look random."""
    return np.mod(np.sin(values * 12.9898) * 43758.5453, 1.0)


def pick(first: np.ndarray, second: np.ndarray, third: np.ndarray | float = 0.0) -> np.ndarray:
    """Give a number to each of the cells of a pattern."""
    return first * 3.17 + second * 7.31 + third * 11.13


def make_noise(points: np.ndarray) -> np.ndarray:
    """Interpolate random numbers at the integer points around, between -0.5 and 0.5."""
    corner = np.floor(points)
    part = points - corner
    part = part * part * (3 - 2 * part)
    total = np.zeros(points.shape[:-1])
    for step in np.ndindex(2, 2, 2):
        at = corner + step
        weight = np.where(step, part, 1 - part).prod(-1)
        total += weight * mix(at @ [1.0, 57.0, 113.0])
    return total - 0.5


def stand(x: float, y: float, z: float, yaw: float) -> Camera:
    """Stand in the room, turned to the right by `yaw` degrees."""
    angle = np.deg2rad(yaw)
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[0, 0] = c2w[2, 2] = np.cos(angle)
    c2w[0, 2], c2w[2, 0] = np.sin(angle), -np.sin(angle)
    c2w[:3, 3] = torch.tensor([x, y, z])
    focal = FOCAL * SIZE
    K = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    return Camera(c2w.float(), K.float(), SIZE, SIZE, near=0.5, far=12.0)


def make_splat(camera: Camera) -> Gaussians:
    """Make a Gaussian of the size of its pixel at the true place of each pixel."""
    image, depth = draw_room(camera)
    means = camera.center + depth[..., None] * camera.z_rays()
    size = 0.6 * depth / camera.K[0, 0]
    return make_observed(
        means=means.reshape(-1, 3),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(depth.numel(), 1),
        scales=size.reshape(-1, 1).repeat(1, 3),
        opacities=torch.full((depth.numel(),), 0.95),
        sh=sh_from_rgb(image.reshape(-1, 3)),
    )


# ------------------------------------------------------------------- the pictures


def run(folder: Path, words: str) -> None:
    """Run a command of gscompleter in the folder, and print it first."""
    print(f"$ gscompleter {words}", flush=True)
    command = [sys.executable, "-m", "gscompleter", *words.split()]
    subprocess.run(command, cwd=folder, check=True)


def make_place(folder: Path) -> None:
    """Write photographs, new photographs without cameras, a splat, and cameras to look from."""
    up = (0.08, -0.08)
    old = [stand(-0.9 + 0.22 * n, up[n % 2], 0.1 * (n % 3), -22 + 2.5 * n) for n in range(OLD)]
    new = [stand(0.3 + 0.3 * n, up[n % 2], 0.1 * (n % 2), 4 + 7 * n) for n in range(NEW)]
    for name, cameras in (("PHOTOS", old), ("NEW", new)):
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / name).mkdir(parents=True)
        for n, camera in enumerate(cameras):
            write_image(folder / name / f"{name.lower()}{n}.png", draw_room(camera)[0])
    names = [f"photos{n}.png" for n in range(OLD)]
    write_cameras(folder / "PHOTOS" / "transforms.json", old, names)
    save_ply(folder / "splat.ply", merge([make_splat(camera) for camera in old[::2]]))
    for name, cameras in LOOKS.items():
        write_cameras(folder / f"{name}.json", cameras)


LOOKS = {
    "tour": [stand(-0.6, 0, 0, -20), stand(0.4, 0, 0, -4), stand(0.8, 0, 0.1, 10)],
    "gap": [stand(0.5, 0, 0.1, -2)],
    "edge": [stand(-1.5, 0, 0.2, -32)],
    "wall": [stand(-0.4, 0, 0.8, -8)],
}
"""Cameras that the commands name, by the name of their file."""


def draw_splat(scene: Gaussians | Path, camera: Camera) -> Image.Image:
    """Draw a splat, or that of a file."""
    scene = gsc.load_splat(scene) if isinstance(scene, Path) else scene
    image = load_renderer("cpu").render(scene, camera).image
    return Image.fromarray((image.clamp(0, 1).numpy() * 255).round().astype(np.uint8))


def tint(path: Path) -> Gaussians:
    """Paint what a file says to be invented in magenta."""
    scene = gsc.load_splat(path)
    is_invented = (scene.generated > 0) & (scene.generated < 255)
    sh = scene.sh.clone()
    sh[is_invented] = 0
    sh[is_invented, :1] = sh_from_rgb(torch.tensor([[0.9, 0.1, 0.7]]))
    return replace(scene, sh=sh)


def save(name: str, panels: list[tuple[Image.Image, str]]) -> None:
    """Put panels side by side, each with its words below."""
    height = max(image.height for image, _ in panels)
    width = sum(image.width for image, _ in panels) + MARGIN * (len(panels) - 1)
    page = Image.new("RGB", (width, height + CAPTION), "white")
    draw, left = ImageDraw.Draw(page), 0
    font = ImageFont.load_default(size=14)
    for image, words in panels:
        page.paste(image, (left, 0))
        draw.text((left + 2, height + 4), words, fill="black", font=font)
        left += image.width + MARGIN
    write_page(page, name)


def write_page(page: Image.Image, name: str) -> None:
    """Write a picture of the guide, and refuse one that is too large for a page."""
    path = DOCS / "loop.webp" if name == "loop" else DOCS / "pictures" / f"{name}.webp"
    path.parent.mkdir(exist_ok=True)
    page.save(path, quality=QUALITY, method=6)
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise SystemExit(f"{path} has {size:,} bytes, more than {MAX_BYTES:,}; lower QUALITY.")
    print(f"{path}: {page.size}, {size:,} bytes", flush=True)


def make_loop(folder: Path) -> None:
    """Show a hole, a photograph from where it is seen, and the hole filled with what that shows."""
    run(folder, "inspect splat.ply --cameras tour.json")
    run(folder, "complete PHOTOS --scene splat.ply --dry-run --out PLAN --overwrite")
    run(folder, "update PHOTOS --scene splat.ply --photos NEW --out OUT --overwrite")
    run(folder, "inspect OUT/completed.ply --cameras tour.json")
    camera = LOOKS["tour"][-1]
    panels = [
        (draw_splat(folder / "splat.ply", camera), "1. where it lacks"),
        (Image.open(folder / "NEW" / "new1.png"), "2. a photograph from there"),
        (draw_splat(folder / "OUT" / "completed.ply", camera), "3. filled, 0 % invented"),
    ]
    save("loop", panels)


def make_splats(folder: Path) -> None:
    """Fill a hole of a splat with photographs, and show what is invented."""
    run(folder, "complete PHOTOS --scene splat.ply --target gap.json --out FILLED --overwrite")
    run(folder, "inspect FILLED")
    camera, out = LOOKS["gap"][0], folder / "FILLED" / "completed.ply"
    before = draw_splat(folder / "splat.ply", camera)
    save("splats", [(before, "before"), (draw_splat(out, camera), "after")])
    panels = [(draw_splat(out, camera), "completed"), (draw_splat(tint(out), camera), "invented")]
    save("invented", panels)


def make_splat_alone(folder: Path) -> None:
    """Fill a hole of a splat without photographs."""
    run(folder, f"complete splat.ply --target edge.json --out ALONE {SMALL}")
    files = (folder / "splat.ply", "before"), (folder / "ALONE" / "completed.ply", "after")
    save("splat-alone", [(draw_splat(file, LOOKS["edge"][0]), words) for file, words in files])


def make_remove(folder: Path) -> None:
    """Take the crate out."""
    low, high = torch.tensor(THINGS["crate"])
    # Gaussians are blurred: a box exactly on the crate leaves its rim, which would be continued.
    low, high = low - 0.08, high + torch.tensor([0.08, 0.0, 0.08])
    box = " ".join(f"{value:g}" for value in (*low.tolist(), *high.tolist()))
    run(folder, f"remove PHOTOS --scene splat.ply --box {box} --out REMOVED {SMALL}")
    scene, camera = gsc.load_splat(folder / "splat.ply"), stand(-0.9, 0, 0.1, -16)
    is_gone = ((scene.means > low) & (scene.means < high)).all(dim=1)
    panels = [
        (draw_splat(scene, camera), "before"),
        (draw_splat(scene[~is_gone], camera), "the crate alone is taken out"),
        (draw_splat(folder / "REMOVED" / "completed.ply", camera), "its place is filled"),
    ]
    save("remove", panels)


def make_repair(folder: Path) -> None:
    """Smear a place of the wall, mark it, and repair it."""
    scene, camera = gsc.load_splat(folder / "splat.ply"), LOOKS["wall"][0]
    is_near = (scene.means - torch.tensor([-0.6, -0.3, 5.0])).norm(dim=1) < 0.45
    # Gaussians five times as large, in colours that are halfway to their mean: a blurred place.
    scales, sh = scene.scales.clone(), scene.sh.clone()
    scales[is_near] *= 5
    sh[is_near] = (sh[is_near] + sh[is_near].mean(dim=0)) / 2
    smeared = replace(scene, scales=scales, sh=sh)
    save_ply(folder / "smeared.ply", smeared)
    before = draw_splat(smeared, camera)
    changed = np.abs(np.subtract(before, draw_splat(scene, camera), dtype=np.float32)).max(-1) > 12
    rows, columns = np.nonzero(changed)
    mask = Image.new("L", before.size)
    ends = (columns.min() - 4, rows.min() - 4, columns.max() + 4, rows.max() + 4)
    ImageDraw.Draw(mask).ellipse(tuple(int(end) for end in ends), fill=255)
    mask.save(folder / "wrong.png")
    run(folder, "repair smeared.ply --target wall.json --mask wrong.png --out REPAIRED --overwrite")
    red = Image.new("RGB", before.size, (230, 40, 40))
    marked = Image.composite(Image.blend(before, red, 0.5), before, mask)
    after = draw_splat(folder / "REPAIRED" / "completed.ply", camera)
    save("repair", [(before, "a smeared place"), (marked, "painted over"), (after, "repaired")])


def make_painting(folder: Path) -> None:
    """Export a hole, paint it with the truth, and read it back."""
    shutil.rmtree(folder / "HOLES", ignore_errors=True)
    words = f"complete PHOTOS --scene splat.ply --target gap.json --out PAINTED {SMALL}"
    run(folder, f"{words} --export-holes HOLES")
    given = Image.open(folder / "HOLES" / "target1.png").convert("RGB")
    mask = Image.open(folder / "HOLES" / "target1_mask.png").convert("L")
    truth = (draw_room(LOOKS["gap"][0])[0].numpy() * 255).round().astype(np.uint8)
    truth_at_its_size = Image.fromarray(truth).resize(given.size)
    painted = Image.composite(truth_at_its_size, given, mask)
    painted.save(folder / "HOLES" / "target1.png")
    words = f"complete PHOTOS --scene splat.ply --out PAINTED {SMALL}"
    run(folder, f"{words} --images HOLES --painter somebody")
    after = Image.open(folder / "PAINTED" / "images" / "target1_after.png").convert("RGB")
    names = ("target1.png", "target1_mask.png", "painted", "of Gaussians")
    save("painting", list(zip((given, mask.convert("RGB"), painted, after), names, strict=True)))


def make_clean(folder: Path) -> None:
    """Put floaters into the splat, and take them out."""
    scene = gsc.load_splat(folder / "splat.ply")
    random = torch.Generator().manual_seed(1)
    rows = torch.randperm(len(scene), generator=random)[:150]
    floaters = scene[rows]
    # Between the room's middle and the wall, as large as a fist.
    place = torch.tensor([-0.5, 0.0, 1.5])
    share = 0.3 + 0.4 * torch.rand(len(rows), 1, generator=random)
    means = place + share * (floaters.means - place)
    scales = 0.02 + 0.04 * torch.rand(len(rows), 3, generator=random)
    save_ply(folder / "floaters.ply", merge([scene, replace(floaters, means=means, scales=scales)]))
    run(folder, "clean --scene floaters.ply --out CLEANED --overwrite")
    picture = Image.open(folder / "CLEANED" / "removed.png").convert("RGB")
    picture.thumbnail((900, 400))
    write_page(picture, "clean")


def make_batch(folder: Path) -> None:
    """Photograph the page of a batch of three scenes, one of which is broken."""
    for name, first in (("hall", 0), ("library", 1)):
        cameras = [stand(-0.5 + 0.3 * n, 0, 0, -10 + 6 * first + 2 * n) for n in range(4)]
        (folder / "SCENES" / name).mkdir(parents=True, exist_ok=True)
        names = [f"{n}.png" for n in range(4)]
        for file, camera in zip(names, cameras, strict=True):
            write_image(folder / "SCENES" / name / file, draw_room(camera)[0])
        write_cameras(folder / "SCENES" / name / "transforms.json", cameras, names)
    broken = folder / "SCENES" / "porch"
    shutil.copytree(folder / "SCENES" / "hall", broken, dirs_exist_ok=True)
    for file in names:
        (broken / file).write_bytes(b"no picture")
    shutil.rmtree(folder / "BATCH", ignore_errors=True)
    words = "batch SCENES --out BATCH --each resolution=128 auto=1"
    print(f"$ gscompleter {words}", flush=True)
    # One scene fails on purpose: the exit code is 3.
    subprocess.run([sys.executable, "-m", "gscompleter", *words.split()], cwd=folder, check=False)
    # The page without the place of the folder on this machine.
    text = (folder / "BATCH" / "index.html").read_text("utf-8")
    page_file = folder / "BATCH" / "page.html"
    page_file.write_text(text.replace(f"{folder.absolute()}/", ""), "utf-8")
    photograph_page(page_file, folder / "batch.png")
    page = Image.open(folder / "batch.png").convert("RGB")
    page.thumbnail((900, 900))
    write_page(page, "batch")


def photograph_page(page: Path, picture: Path) -> None:
    """Draw a page in chromium, without the seconds of its last line."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        path = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 1250, "height": 900})
        tab.goto(page.absolute().as_uri())
        tab.screenshot(path=picture, clip={"x": 0, "y": 50, "width": 1250, "height": 740})


PICTURES: dict[str, Callable[[Path], None]] = {
    "loop": make_loop,
    "splats": make_splats,
    "splat-alone": make_splat_alone,
    "remove": make_remove,
    "repair": make_repair,
    "painting": make_painting,
    "clean": make_clean,
    "batch": make_batch,
}


def main() -> None:
    """Draw the place, and make the pictures that are named."""
    folder, names = Path(sys.argv[1]), sys.argv[2:] or list(PICTURES)
    if not (folder / "splat.ply").is_file():
        make_place(folder)
    for name in names:
        PICTURES[name](folder)


if __name__ == "__main__":
    main()
