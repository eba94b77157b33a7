"""Panoramas of the room."""

from pathlib import Path

import numpy as np
import torch

from gscompleter.system.files.image import write_image
from scenes import Room, cast_rays

WIDTH = 640


def panorama(path: Path, centre: tuple[float, float, float], yaw: float = 0.0) -> Path:
    """Write a panorama of the room whose middle faces `yaw` degrees, cast ray by ray."""
    longitude = ((torch.arange(WIDTH).double() + 0.5) / WIDTH * 2 - 1) * torch.pi
    latitude = ((torch.arange(WIDTH // 2).double() + 0.5) / WIDTH * 2 - 0.5) * torch.pi
    down, turn = torch.meshgrid(latitude, longitude + np.radians(yaw), indexing="ij")
    rays = [turn.sin() * down.cos(), down.sin(), turn.cos() * down.cos()]
    write_image(path, cast_rays(Room(), torch.tensor(centre).double(), torch.stack(rays, -1))[0])
    return path
