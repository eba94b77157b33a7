"""From an exhibit to a page: one HTML file that asks for nothing, from anywhere it is opened.

The page has axes of its own, those of three.js (x right, y up, z back), its origin in the middle
of the scene, and a unit in which the scene is about `EXTENT` large. So the few bits that a .spz
gives to positions and sizes suffice for a scene in millimetres and for one in kilometres.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError, quoted
from gscompleter.splats.spz import packed_spz
from gscompleter.types import Camera, Gaussians
from gscompleter.viewer.exhibit import Exhibit, Shot
from gscompleter.viewer.packages import Libraries

ASSETS = Path(__file__).with_name("assets")
"""What we wrote of the page."""
EXTENT = 4.0
"""Half of the Gaussians lie within this of the middle, or within twice as much, in the page."""
REACH = 4096.0
"""How far from the middle a Gaussian may lie, in the unit of the page: ten bits behind the point
are left for all others then."""
LARGEST_PAGE = 60_000_000
"""Bytes of Gaussians that the page itself holds; of more, all lie in files beside it."""
PART = 48_000_000
"""Bytes of Gaussians in one file beside the page, far below the longest string of any browser."""
THREE_FROM_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""Half a turn about x: for the axes of the world, and for those of a camera."""
MOST_LANDMARKS = 100_000
"""Gaussians, about, that tell how far a camera looks."""
OVERVIEW_SIZE = (640, 480)
"""Width and height of the camera of a scene that comes with none."""
OVERVIEW_FOCAL = 550.0
"""Its focal length in pixels: it sees 60 degrees."""
OVERVIEW_DISTANCE = 2.5
"""How far from the middle it stands, in what half of the Gaussians lie within."""


@dataclass(frozen=True)
class Frame:
    """Where the page's own frame lies in that of the scene."""

    centre: Float[Tensor, "3"]
    """The page's origin, in the scene."""
    unit: float
    """The page's unit in those of the scene, a power of two."""

    def moved(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians in the page's origin and unit, and in their own axes."""
        means = ((gaussians.means.double() - self.centre) / self.unit).float()
        return replace(gaussians, means=means, scales=gaussians.scales / self.unit, encoded=None)

    def pose(self, camera: Camera) -> Float[Tensor, "4 4"]:
        """Camera-to-world with the axes of three.js for both, in the page's origin and unit."""
        c2w = camera.c2w.detach().cpu().double().clone()
        c2w[:3, 3] = (c2w[:3, 3] - self.centre) / self.unit
        return THREE_FROM_OPENCV @ c2w @ THREE_FROM_OPENCV


@dataclass(frozen=True)
class Page:
    """What has to be written or served."""

    html: bytes
    parts: Mapping[str, bytes]
    """Scripts that hold the Gaussians, by their file names; none where the page holds them."""
    left_out: int
    """Gaussians of the scene after that lie too far out to be shown."""


def frame_of_scene(gaussians: Gaussians) -> Frame:
    """The middle of a scene, and how large it is."""
    means = gaussians.means.double().cpu()
    centre = means.median(dim=0).values
    spread = (means - centre).norm(dim=1).median().item()
    return Frame(centre, 2.0 ** math.floor(math.log2(spread / EXTENT)) if spread > 0 else 1.0)


def make_page(exhibit: Exhibit, libraries: Libraries, name: str = "page") -> Page:
    """The page of an exhibit; the same values give the same bytes.

    Args:
        exhibit: What it shows.
        libraries: What draws it.
        name: Of the page's file without its ending, after which files beside it are called.

    Raises:
        InputError: where nothing is left to show.
    """
    frame = frame_of_scene(exhibit.after)
    layers = {key: frame.moved(part.to("cpu")) for key, part in layers_of(exhibit).items()}
    shown = {key: part[part.means.norm(dim=1) <= REACH] for key, part in layers.items()}
    packed = {key: packed_spz(Path(key), part) for key, part in shown.items() if len(part) > 0}
    if not packed.keys() - {"before"}:
        raise InputError(f"{quoted(exhibit.title)} has nothing that a page can show.")
    means, layer_sources = landmarks(layers), sources_of(packed)
    sources = {key: packed[key] for key in sorted(set(layer_sources.values()))}
    content = {
        "title": exhibit.title,
        "frame": {"centre": frame.centre.tolist(), "unit": frame.unit},
        "counts": {key: len(part) for key, part in shown.items()},
        "layers": layer_sources,
        "antialiased": {key: part.is_antialiased for key, part in layers.items()},
        "parts": {key: len(part_starts(source)) for key, source in sources.items()},
        "shots": [described(shot, frame, means) for shot in shots_of(exhibit)],
        **vars(libraries),
    }
    scripts, beside = placed(list(calls_with(sources)), name)
    left_out = sum(len(layers[key]) - len(shown[key]) for key in ("observed", "generated"))
    return Page(filled(content, scripts).encode(), beside, left_out)


def layers_of(exhibit: Exhibit) -> dict[str, Gaussians]:
    """The Gaussians that are drawn apart: those before, and of those after the two kinds."""
    after, before = exhibit.after, exhibit.before
    layers = {"observed": after[after.generated == 0], "generated": after[after.generated > 0]}
    return layers if before is None else {"before": before, **layers}


def sources_of(packed: Mapping[str, bytes]) -> dict[str, str]:
    """Which bytes each layer is made of: where nothing changed, what was there before and what was
    observed are the same."""
    sources = {key: key for key in packed}
    if "before" in packed and packed["before"] == packed.get("observed"):
        sources["before"] = "observed"
    return sources


def part_starts(content: bytes) -> range:
    """Where the parts begin that the bytes of a source are handed over in."""
    return range(0, len(content), PART)


def calls_with(packed: Mapping[str, bytes]) -> Iterator[bytes]:
    """Scripts that hand the bytes of each source to the page, in their order."""
    for key, content in packed.items():
        for start in part_starts(content):
            text = base64.b64encode(content[start : start + PART]).decode()
            yield f'gscPart("{key}", "{text}");'.encode()


def placed(calls: list[bytes], name: str) -> tuple[list[str], dict[str, bytes]]:
    """The elements of the page that run these scripts, and the files beside it that they name.

    Args:
        calls: The scripts.
        name: Of the page's file without its ending.
    """
    if sum(map(len, calls)) <= LARGEST_PAGE:
        return [f"<script>{call.decode()}</script>" for call in calls], {}
    files = {f"{name}.{number}.js": call for number, call in enumerate(calls, start=1)}
    return [f'<script src="{quote(file)}"></script>' for file in files], files


def shots_of(exhibit: Exhibit) -> tuple[Shot, ...]:
    """The cameras of an exhibit; one before the whole scene where it has none."""
    if exhibit.shots:
        return exhibit.shots
    means = exhibit.after.means.cpu()
    centre = means.median(dim=0).values
    distance = OVERVIEW_DISTANCE * (means - centre).norm(dim=1).median()
    c2w, K, (width, height) = torch.eye(4), torch.eye(3), OVERVIEW_SIZE
    c2w[:3, 3] = centre - distance * torch.tensor([0.0, 0.0, 1.0])
    K[0, 0] = K[1, 1] = OVERVIEW_FOCAL
    K[:2, 2] = torch.tensor([width / 2, height / 2])
    return (Shot("overview", "Overview", Camera(c2w, K, width, height)),)


def landmarks(layers: Mapping[str, Gaussians]) -> Float[Tensor, "n 3"]:
    """Where some Gaussians of the scene after lie, spread over all, in the page's origin and unit
    and the axes of the scene."""
    means = torch.cat([layers["observed"].means, layers["generated"].means])
    return means[:: max(1, len(means) // MOST_LANDMARKS)].double()


def described(shot: Shot, frame: Frame, means: Float[Tensor, "n 3"]) -> dict[str, Any]:
    """A camera as the page reads it, which looks at what `landmarks` are before it."""
    K, pose = shot.camera.K.double(), frame.pose(shot.camera)
    picture = None if shot.thumbnail is None else base64.b64encode(shot.thumbnail).decode()
    return {
        "name": shot.name,
        "title": shot.title,
        "notes": shot.notes,
        "pose": pose.flatten().tolist(),
        "lens": [K[0, 0].item(), K[1, 1].item(), K[0, 2].item(), K[1, 2].item()],
        "size": [shot.camera.width, shot.camera.height],
        "focus": focus_of(shot.camera, pose, means),
        "thumbnail": picture,
    }


def focus_of(camera: Camera, pose: Float[Tensor, "4 4"], means: Float[Tensor, "n 3"]) -> float:
    """The median z-depth of what a camera has before it, in the unit of the page.

    Args:
        camera: For its intrinsics.
        pose: As `Frame.pose` gives it.
        means: Of some Gaussians, as `landmarks` gives them.
    """
    flip = THREE_FROM_OPENCV[:3, :3]
    x, y, z = ((means @ flip - pose[:3, 3]) @ pose[:3, :3] @ flip).unbind(1)
    K = camera.K.double()
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    seen = (z > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    return z[seen].median().item() if seen.any() else EXTENT


def filled(content: Mapping[str, Any], scripts: list[str]) -> str:
    """The page of `viewer.html` with everything that it needs in it.

    Text from outside comes in as JSON without a `<`, which no parser of HTML can mistake.
    """
    data = json.dumps(content, sort_keys=True).replace("<", "\\u003c")
    texts = {
        "title": html.escape(str(content["title"])),
        "style": asset("viewer.css"),
        "program": asset("viewer.js"),
        "parts": "\n".join(scripts),
        "data": data,
    }
    pieces = asset("viewer.html").split("{{")
    named = (piece.split("}}", 1) for piece in pieces[1:])
    return pieces[0] + "".join(texts[name] + rest for name, rest in named)


def asset(name: str) -> str:
    """One of our files of the page."""
    return (ASSETS / name).read_text(encoding="utf-8")
