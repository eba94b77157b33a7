"""A stand-in for the process that runs COLMAP, and the comparison of positions that it finds."""

import json
from pathlib import Path

import numpy as np
import pytest

from gscompleter.data.sfm import poses


def similarity_removed(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Align `found` positions [n, 3] to the `true` ones by a similarity."""
    a, b = found - found.mean(0), true - true.mean(0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    scale = (S * signs).sum() / (a**2).sum()
    return scale * a @ (U @ np.diag(signs) @ Vt).T + true.mean(0)


def stand_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: str) -> None:
    """Replace the process that runs COLMAP by a script."""
    (tmp_path / "stand_in_mapping.py").write_text(script)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(poses, "MAPPING_PROCESS", "stand_in_mapping")
    monkeypatch.setattr(poses, "find_spec", lambda name: True)  # COLMAP itself is not needed


def model_script(
    registered: list[str],
    points: int = 90,
    plausible: bool = True,
    focal: float | None = None,
    features: str = "SIFT",
    contradicted: tuple[str, ...] = (),
    lacks_learned: bool = False,
) -> str:
    """Write a script that reports these photographs as registered."""
    result = {
        "registered": registered,
        "points": points,
        "error": 0.5,
        "is_plausible": plausible,
        "focal": focal,
        "features": features,
        "contradicted": contradicted,
        "lacks_learned": lacks_learned,
    }
    return f"""
import json, pathlib, sys
pathlib.Path(json.load(sys.stdin)["model"]).mkdir(parents=True)
print("a line of COLMAP")
print({json.dumps(result)!r})
"""
