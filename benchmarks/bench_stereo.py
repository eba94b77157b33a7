"""Time and accuracy of the embedded stereo and OpenCV's, on the motorcycle pair.

    python benchmarks/bench_stereo.py

OpenCV's semi-global matcher gets a rectified pair and a range of disparities, ours two posed
photographs. Pixels without depth count as errors.
"""

from __future__ import annotations

import time
from dataclasses import replace

import cv2
import numpy as np
import torch
from skimage.data import stereo_motorcycle
from skimage.restoration import denoise_tv_chambolle

from gscompleter import View
from gscompleter.data.demo_scene import (
    BASELINE_M,
    FOCAL_PX,
    PRINCIPAL_POINT_DX_PX,
    get_motorcycle_cameras,
)
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.reconstructors.plane_sweep.surfaces import SMOOTHING_ITERATIONS, fit_surfaces


def report(name: str, depth: np.ndarray, truth: np.ndarray, seconds: float) -> None:
    """Print the shares of pixels within 5 % and 2 % of the truth, and the time."""
    known = truth > 0
    error = np.abs(depth[known] - truth[known]) / truth[known]
    shares = [100 * np.mean(np.nan_to_num(error, nan=1.0) < t) for t in (0.05, 0.02)]
    print(f"{name:24s} {shares[0]:6.1f} % {shares[1]:6.1f} % {seconds:8.2f} s")


def main() -> None:
    """Print the table, at half the size of the photographs."""
    left, right, disparity = stereo_motorcycle()
    halves = [np.ascontiguousarray(cv2.resize(i, None, fx=0.5, fy=0.5)) for i in (left, right)]
    # Unknown disparities are infinite and give depth 0.
    truth = (FOCAL_PX * BASELINE_M / (disparity + PRINCIPAL_POINT_DX_PX))[::2, ::2]
    height, width = halves[0].shape[:2]
    truth = truth[:height, :width]
    half = torch.tensor([[0.5], [0.5], [1.0]])
    cameras = [
        replace(c, K=c.K * half, width=width, height=height)
        for c in get_motorcycle_cameras(741, 500)
    ]
    views = [
        View(torch.from_numpy(i / 255).float(), c) for i, c in zip(halves, cameras, strict=True)
    ]

    print(f"{'':24s} {'< 5 %':>8s} {'< 2 %':>8s} {'':>10s}")
    PlaneSweep()(views)
    start = time.perf_counter()
    PlaneSweep()(views)
    whole = time.perf_counter() - start
    start = time.perf_counter()
    found = PlaneSweep().estimate_depths(views)[0].depth.numpy()
    ours = time.perf_counter() - start
    report("plane-sweep (both views)", found, truth, ours)

    matcher = cv2.StereoSGBM.create(0, 48, 5, 8 * 75, 32 * 75, 1, 63, 10, 100, 2)
    start = time.perf_counter()
    matched = matcher.compute(*halves).astype(np.float64) / 16
    theirs = time.perf_counter() - start
    matched[matched <= 0] = np.nan
    depth = 0.5 * FOCAL_PX * BASELINE_M / (matched + 0.5 * PRINCIPAL_POINT_DX_PX)
    report("OpenCV StereoSGBM (left)", depth, truth, theirs)
    print(f"time: {ours / theirs:.1f} x that of OpenCV, for two dense depth maps instead of one")
    print(f"photographs to Gaussians, fitted to their photographs: {whole:.2f} s")

    heights = (1 / found).astype(np.float32)
    start = time.perf_counter()
    fit_surfaces(heights, np.ones_like(heights), halves[0].astype(np.float32) / 255)
    surfaces = time.perf_counter() - start
    start = time.perf_counter()
    denoise_tv_chambolle(heights, weight=0.1, eps=0.0, max_num_iter=SMOOTHING_ITERATIONS)
    first_order = time.perf_counter() - start
    print(
        f"{SMOOTHING_ITERATIONS} iterations: surfaces (second order, all levels) {surfaces:.2f} s, "
        f"{surfaces / first_order:.2f} x scikit-image's total variation (one level)"
    )


if __name__ == "__main__":
    main()
