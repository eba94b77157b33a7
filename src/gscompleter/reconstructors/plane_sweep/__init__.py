"""Ψ without weights: plane-sweep stereo that turns posed photographs into Gaussians."""

from gscompleter.reconstructors.plane_sweep.reconstructor import PlaneSweep

__all__ = ["PlaneSweep"]
