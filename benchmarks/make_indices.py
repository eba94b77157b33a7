"""Write the evaluation indices of the paper's protocols that the package contains.

    python benchmarks/make_indices.py RE10K_INDEX ACID_INDEX DL3DV_INDEX

The paper publishes no index. Ours has one case for each scene, the first of our reading of n-k
(frames 0 and k for 2k), or the stress test (0 and 30 for 99); see evaluation/indices/README.md. The
arguments are the published indices of the interpolation task, which name the test scenes:
`evaluation_index_re10k.json` and `evaluation_index_acid.json` of MVSplat's `assets` (at commit
175b17a6), and `dl3dv_start_0_distance_10_ctx_2v_tgt_4v.json` of DepthSplat's (2dad25a7). They show
how long a scene is at least: a scene is taken if a frame at or beyond the last one that we need is
named there. For DL3DV all 140 scenes are taken, since DepthSplat's indices of distance 100 sample
the first hundred frames of each.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from gscompleter.evaluation.protocols import Split, extrapolate, split_stress_test

OUT = Path(__file__).resolve().parents[1] / "src" / "gscompleter" / "evaluation" / "indices"
DL3DV_FRAMES = 100
"""Frames that each scene of the DL3DV benchmark has at least."""


def main() -> None:
    """Write all indices."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("re10k", "acid", "dl3dv"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    for name in ("re10k", "acid"):
        published = json.loads(getattr(options, name).read_text())
        lengths = {
            scene: 1 + max(*split["context"], *split["target"])
            for scene, split in published.items()
            if split is not None
        }
        write_index(f"{name}-n-30", {s: extrapolate(n, 30) for s, n in lengths.items()})
    lengths = dict.fromkeys(json.loads(options.dl3dv.read_text()), DL3DV_FRAMES)
    for k in (10, 20, 30):
        write_index(f"dl3dv-n-{k}", {s: extrapolate(n, k) for s, n in lengths.items()})
    write_index("dl3dv-stress", {s: split_stress_test(n) for s, n in lengths.items()})


def write_index(name: str, scenes: dict[str, tuple[Split, ...]]) -> None:
    """Write the first case of each scene in the format of pixelSplat, a line for each scene."""
    lines = []
    for scene in sorted(scenes):
        if not scenes[scene]:
            continue
        first = scenes[scene][0]
        split = {"context": list(first.context), "target": list(first.targets)}
        lines.append(f"{json.dumps(scene)}: {json.dumps(split)}")
    (OUT / f"{name}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")
    print(f"{name}: {len(lines)} scenes")


if __name__ == "__main__":
    main()
