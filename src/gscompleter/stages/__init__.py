"""The steps of a completion, a file each.

Those of the paper, in its order: `context`, `synthesize`, `select_anchor`, `lift`, `align_depth`,
`slide_along_rays`, `filter_holes` and `refine`. Ours are `recolor` and `new_photos`, for splats
that somebody trained, and `find_unfilled`, for the report. `target_view` is the scene as one target
sees it, which all of them read.
"""

from __future__ import annotations

from gscompleter.stages.align_depth import align_depth as align_depth
from gscompleter.stages.filter_holes import filter_holes as filter_holes
from gscompleter.stages.lift import lift as lift
from gscompleter.stages.refine import refine as refine
from gscompleter.stages.slide_along_rays import slide_along_rays as slide_along_rays
from gscompleter.stages.synthesize import synthesize as synthesize
from gscompleter.stages.target_view import compute_hole_mask as compute_hole_mask
from gscompleter.stages.target_view import render_target as render_target
