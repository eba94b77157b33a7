"""Makes one self-contained HTML file that loads nothing from the network.

The page has the axes of three.js (x right, y up, z back), its origin at the centre of the scene,
and a unit in which the scene has about the size `PAGE_EXTENT`, which suits the few bits of a .spz.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.apps.viewer.exhibit import ViewerCamera, ViewerContent
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.numerics.geometry import embed_cameras, is_inside, look_along, project
from gscompleter.splats.spz import ENCODED_BLOCK, encode_spz_blocks
from gscompleter.splats.upward import USUAL, Direction
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.text import encode_text
from gscompleter.types import Camera, Gaussians

ASSETS = Path(__file__).with_name("assets")
PROGRAM_FILES = (
    "state",
    "libraries",
    "pictures",
    "camera",
    "path",
    "marks",
    "saving",
    "box",
    "connection",
    "controls",
    "texts",
    "start",
)
"""Files of the page's program in their order. While one is loaded it uses only names of those
before it; functions that are called later may use all."""
PAGE_EXTENT = 4.0
"""Extent of the scene (`measure_shown_extent`), within a factor of 2, in page units."""
MAX_PAGE_DISTANCE = 4096.0
"""Largest distance of a Gaussian from the centre, in page units; leaves ten fractional bits."""
MAX_SCRIPT_BYTES = 48_000_000
"""Bytes of Gaussians per script element, below the longest string of any browser."""
SOURCES_MARK = "\0"
"""Character that stands in the page for its sources, and that no text of it can have."""
THREE_FROM_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""Half a turn about x, for the axes of the world and of a camera."""
MAX_LANDMARKS = 100_000
"""Approximate number of Gaussians that determine the focus of a camera."""
OVERVIEW_DISTANCE = 2.5
"""Distance of a camera for the whole scene, relative to its extent (`measure_shown_extent`)."""
SHOWN_DEVIATIONS = 2.0
"""Standard deviations from its centre up to which a Gaussian is seen."""

LEG_SECONDS = 2.0
"""Mean time of the camera path from one camera to the next."""


@dataclass(frozen=True)
class PageFrame:
    """The frame of the page."""

    centre: Float[Tensor, "3"]
    """Origin of the page, in the scene."""
    unit: float
    """Unit of the page in scene units, a power of two."""

    def normalize(self, gaussians: Gaussians) -> Gaussians:
        """Move Gaussians to the page's origin and unit; their axes stay."""
        centre = self.centre.to(gaussians.means.device)
        means = ((gaussians.means.double() - centre) / self.unit).float()
        return replace(gaussians, means=means, scales=gaussians.scales / self.unit, encoded=None)

    def move_camera(self, camera: Camera) -> Camera:
        """Move a camera to the page's origin and unit, in float64; its axes stay."""
        c2w = camera.c2w.detach().cpu().double().clone()
        c2w[:3, 3] = (c2w[:3, 3] - self.centre) / self.unit
        return replace(camera, c2w=c2w, K=camera.K.double())


def compute_page_frame(gaussians: Gaussians) -> PageFrame:
    """Compute the page's frame from the median position and the extent of Gaussians."""
    means = gaussians.means.double().cpu()
    centre = means.median(dim=0).values
    extent = measure_shown_extent(means, centre, gaussians.scales)
    # A power of two scales floats without rounding.
    power = math.floor(math.log2(extent / PAGE_EXTENT))
    return PageFrame(centre, 2.0**power)


def measure_shown_extent(
    means: Float[Tensor, "n 3"], centre: Float[Tensor, "3"], scales: Float[Tensor, "n 3"]
) -> float:
    """Measure the median distance of Gaussians from the centre, in scene units, above 0.

    Where most of them are in one place, as a single one is, what is seen is their own size.
    """
    spread = (means - centre).norm(dim=1).median().item()
    size = SHOWN_DEVIATIONS * scales.amax(dim=1).median().item()
    return spread or size or 1.0


def is_within_page(gaussians: Gaussians, frame: PageFrame) -> Bool[Tensor, "n"]:
    """Find the Gaussians that are near enough to be shown."""
    # .spz has fixed-point positions: what lies beyond their range cannot be written. In float64
    # positions take much memory, and so are moved some at a time.
    is_within = torch.empty_like(gaussians.opacities, dtype=torch.bool)
    for start in range(0, len(gaussians), ENCODED_BLOCK):
        block = slice(start, start + ENCODED_BLOCK)
        is_within[block] = frame.normalize(gaussians[block]).means.norm(dim=1) <= MAX_PAGE_DISTANCE
    return is_within


def make_page(
    viewer_content: ViewerContent, libraries: Libraries, is_live: bool = False
) -> tuple[bytes, tuple[str, ...]]:
    """Make the page, and sentences on missing content; the same values give the same bytes.

    A live page may ask the server that it came from, and no other.
    """
    parts, notes = make_page_parts(viewer_content, libraries, is_live)
    return b"".join(parts), notes


def make_page_parts(
    viewer_content: ViewerContent, libraries: Libraries, is_live: bool = False
) -> tuple[Iterator[bytes], tuple[str, ...]]:
    """Make a page as `make_page` does, part by part, so that it is never in memory as a whole."""
    frame = compute_page_frame(viewer_content.after)
    after = viewer_content.after
    # The Gaussians of each layer by number: a copy of a layer would take as much as its scene.
    scenes = {} if viewer_content.before is None else {"before": viewer_content.before}
    scenes |= {"observed": after, "generated": after}
    layers = {name: torch.arange(len(scene)) for name, scene in scenes.items()}
    layers["observed"] = (after.generated == 0).nonzero()[:, 0].cpu()
    layers["generated"] = (after.generated > 0).nonzero()[:, 0].cpu()
    shown = {
        name: rows[is_within_page(scenes[name], frame).cpu()[rows]] for name, rows in layers.items()
    }
    sources = {
        name: encode_layer(name, scenes[name], rows, frame)
        for name, rows in shown.items()
        if len(rows) > 0
    }
    if not sources.keys() - {"before"}:
        raise InputError(f"{quote_value(viewer_content.title)} has nothing that a page can show.")

    # Most completions leave the context as it is, which is then embedded once for both layers.
    layer_sources = {name: name for name in sources}
    if "before" in sources and sources["before"] == sources.get("observed"):
        del sources["before"]
        layer_sources["before"] = "observed"

    order = torch.cat([layers["observed"], layers["generated"]])
    order = order[:: max(1, len(order) // MAX_LANDMARKS)].to(after.means.device)
    landmarks = frame.normalize(after[order]).means.double().cpu()
    up = viewer_content.up
    cameras = viewer_content.cameras or (make_overview(viewer_content.after, up or USUAL),)
    content = {
        "title": viewer_content.title,
        "frame": {"centre": place_page(frame, after, is_live), "unit": frame.unit},
        "counts": {name: len(rows) for name, rows in shown.items()},
        "layers": layer_sources,
        "antialiased": {name: scene.is_antialiased for name, scene in scenes.items()},
        "path": plan_tour([camera.camera for camera in cameras]),
        "live": is_live,
        "up": None if up is None else turn_to_page(up),
        "shots": [describe_page_camera(camera, frame, landmarks) for camera in cameras],
        **vars(libraries),
    }
    omitted = sum(len(layers[name]) - len(shown[name]) for name in ("observed", "generated"))
    notes = (f"{omitted:,} Gaussians are too far away to be shown.",) if omitted else ()
    head, tail = fill_template(content, SOURCES_MARK).split(SOURCES_MARK)
    page = chain([encode_text(head)], make_scripts(sources), [encode_text(tail)])
    return page, (*viewer_content.notes, *notes)


def place_page(frame: PageFrame, scene: Gaussians, is_live: bool) -> list[float]:
    """Place the origin of the page in the coordinates that it shows and saves.

    They are those of the file, and in a session those of its scene, which the server moves.
    """
    origin = torch.tensor(scene.origin or (0, 0, 0), dtype=torch.float64)
    centre = frame.centre.double().cpu()
    return (centre if is_live else centre + origin).tolist()


def encode_layer(name: str, scene: Gaussians, rows: Int64[Tensor, "m"], frame: PageFrame) -> bytes:
    """Encode rows of a scene as a .spz in the frame of the page, some at a time."""

    def make_blocks() -> Iterator[Gaussians]:
        for block in rows.split(ENCODED_BLOCK):
            yield frame.normalize(scene[block.to(scene.means.device)]).to("cpu")

    return encode_spz_blocks(Path(name), make_blocks)


def make_scripts(sources: dict[str, bytes]) -> Iterator[bytes]:
    """Make the script elements that hold the bytes of each source in base64, piece by piece.

    The sources are taken out of the table one by one. Each element but the first begins a line.
    """
    separator = b""
    for name in sorted(sources):
        content = sources.pop(name)
        for start in range(0, len(content), MAX_SCRIPT_BYTES):
            yield separator + b'<script>gscPart("%s", "' % name.encode()
            yield base64.b64encode(content[start : start + MAX_SCRIPT_BYTES])
            yield b'");</script>'
            separator = b"\n"


def make_overview(scene: Gaussians, up: Direction) -> ViewerCamera:
    """Make a camera that sees the scene from aside, for a page without any other."""
    means = scene.means.cpu()
    centre = means.median(dim=0).values
    distance = OVERVIEW_DISTANCE * measure_shown_extent(means, centre, scene.scales)
    upward = normalize(torch.tensor(up), dim=0)
    # Along z, as photographs look if y is down; or along y if z is the axis that is upright.
    aside = torch.eye(3)[2 if upward[2].abs() < upward.abs().amax() else 1]
    forward = aside - upward * (aside @ upward)
    c2w = torch.eye(4)
    c2w[:3, 3] = centre - distance * normalize(forward, dim=0)
    K = torch.tensor([[550.0, 0.0, 320.0], [0.0, 550.0, 240.0], [0.0, 0.0, 1.0]])
    camera = look_along(Camera(c2w, K, 640, 480), forward, upward)
    return ViewerCamera("overview", "Overview", camera, has_frame=False)


def turn_to_page(direction: Direction) -> list[float]:
    """Turn a direction of the scene to the axes of the page."""
    x, y, z = direction
    return [x, -y, -z]


def describe_page_camera(
    view_camera: ViewerCamera, frame: PageFrame, landmarks: Float[Tensor, "n 3"]
) -> dict[str, Any]:
    """Describe a camera as the page reads it, focused on landmarks in page unit and scene axes."""
    camera = frame.move_camera(view_camera.camera)
    thumbnail = view_camera.thumbnail
    K = camera.K
    pixels, depths = project(landmarks, camera)
    # A camera at the focus of its view orbits what it looks at: the median depth of what it sees.
    seen = depths[is_inside(pixels, depths, camera)]
    return {
        "name": view_camera.name,
        "title": view_camera.title,
        "notes": view_camera.notes,
        "pose": (THREE_FROM_OPENCV @ camera.c2w @ THREE_FROM_OPENCV).flatten().tolist(),
        "lens": [K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()],
        "size": [camera.width, camera.height],
        "framed": view_camera.has_frame,
        "focus": seen.median().item() if len(seen) else PAGE_EXTENT,
        "thumbnail": None if thumbnail is None else base64.b64encode(thumbnail).decode(),
    }


def plan_tour(cameras: Sequence[Camera]) -> list[tuple[int, float]]:
    """Plan a path from the first camera, each time to the nearest one left: indices and seconds."""
    places = embed_cameras([camera.to("cpu") for camera in cameras]).double()
    apart = torch.cdist(places, places)
    # Visited cameras are infinitely far.
    handicap = torch.zeros(len(places))
    stops = [0]
    for _ in cameras[1:]:
        handicap[stops[-1]] = torch.inf
        stops.append(int((apart[stops[-1]] + handicap).argmin()))
    # A leg of four times the length takes twice the time; no leg takes none.
    legs = apart[stops[:-1], stops[1:]].sqrt()
    legs = legs / legs.mean().clamp_min(1e-9) + 0.1
    times = LEG_SECONDS * legs.cumsum(dim=0)
    return list(zip(stops, [0.0, *times.tolist()], strict=True))


def fill_template(content: Mapping[str, Any], scripts: str) -> str:
    """Fill the template `viewer.html`, with `scripts` in the place of the elements of its sources.

    External text is inserted as JSON without `<`, which no HTML parser can misread.
    """
    texts = {
        "title": html.escape(str(content["title"])),
        "origins": "'self' data: blob:" if content["live"] else "data: blob:",
        "style": read_asset("viewer.css"),
        "program": read_program(),
        "parts": scripts,
        # `</script>` in a text would end the element.
        "data": json.dumps(content, sort_keys=True).replace("<", "\\u003c"),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda name: texts[name[1]], read_asset("viewer.html"))


def read_program() -> str:
    """Read the page's program: its files, one after the other, share their names."""
    return "".join(read_asset(f"{name}.js") for name in PROGRAM_FILES)


def read_asset(name: str) -> str:
    """Read one of our page sources."""
    return (ASSETS / name).read_text(encoding="utf-8")
