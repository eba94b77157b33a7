"""Ψ without weights: plane-sweep stereo, from posed photographs to pixel-sized Gaussians."""

from gscompleter.reconstructors.plane_sweep.reconstructor import PlaneSweep

__all__ = ["PlaneSweep"]
