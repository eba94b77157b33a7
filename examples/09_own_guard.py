"""A guard of your own: it moves, fades or drops what would be added.

    gscompleter complete SCENE --out OUT --config.guards psnr examples/09_own_guard.py:DropFaint

It is asked in its place among the others. Hooks that it does not have keep everything; one that
drops all Gaussians rejects the target, with its sentence in the report.
"""

import gscompleter as gsc


class DropFaint(gsc.Guard):
    """Drop added Gaussians that are almost transparent."""

    name = "drop-faint"
    min_opacity = 0.2

    def verify(self, added: gsc.Gaussians, attempt: gsc.Attempt) -> gsc.Gaussians:
        """Keep what covers what is behind it."""
        return added[added.opacities >= self.min_opacity]

    def explain_rejection(self, attempt: gsc.Attempt) -> str:
        """Write the sentence for a target of which nothing is left."""
        return f"Everything that was added is fainter than {self.min_opacity}."
