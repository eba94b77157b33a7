"""Writers of pixelSplat chunks of a synthetic room."""

import io
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gscompleter.types import View
from scenes import Room, camera_at, view_of

SIZE = 64
VIEWS = [
    view_of(Room(), camera_at(x=0.1 * i, y=0.05 * i, yaw=4.0 * i, size=SIZE)) for i in range(5)
]


def pixels_of(view: View) -> np.ndarray:
    return (view.image * 255).round().to(torch.uint8).numpy()


def file_bytes(pixels: np.ndarray, form: str = "PNG") -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format=form, quality=95, subsampling=0)
    return buffer.getvalue()


def as_tensor(data: bytes) -> torch.Tensor:
    return torch.from_numpy(np.frombuffer(data, dtype=np.uint8).copy())


def row_of(view: View) -> torch.Tensor:
    camera = view.camera
    w, h, K = camera.width, camera.height, camera.K
    intrinsics = torch.stack([K[0, 0] / w, K[1, 1] / h, K[0, 2] / w, K[1, 2] / h])
    viewmat = torch.linalg.inv(camera.c2w.double())[:3].flatten().float()
    return torch.cat([intrinsics, torch.zeros(2), viewmat])


def example(key: str = "room", form: str = "JPEG", views: list[View] = VIEWS) -> dict:
    return {
        "key": key,
        "url": "https://example.org/room",
        "timestamps": torch.arange(len(views)) * 33,
        "cameras": torch.stack([row_of(view) for view in views]),
        "images": [as_tensor(file_bytes(pixels_of(view), form)) for view in views],
    }


def save_chunk(path: Path, *examples: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(list(examples), path)
    return path


def save_dataset(root: Path) -> Path:
    """Write three scenes in two chunks, as the test split of a data set."""
    save_chunk(root / "test" / "000000.torch", example("a"), example("b"))
    save_chunk(root / "test" / "000001.torch", example("c"))
    index = {"a": "000000.torch", "b": "000000.torch", "c": "000001.torch"}
    (root / "test" / "index.json").write_text(json.dumps(index))
    return root
