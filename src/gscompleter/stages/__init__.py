"""The steps of a completion, a file each.

Those of the paper, in its order: `context`, `synthesize`, `select_anchor`, `lift`, `align_paper`,
`register_paper`, `hole_masks`, `filter_holes` and `refine`. Ours are `align_depth`, `register` (and
`extrapolate_registration`), `recolor` and `new_photos`, for splats that somebody trained, and
`find_unfilled`, for the report; `context_geometry` and `given_geometry` use a scan or a mesh;
`replace_contested` and `remake_scene` change what earlier commands made. `target_view` is the scene
as one target sees it, which all of them read; `additions` is what they hand on, and the one way
into the scene.
"""

from __future__ import annotations

from gscompleter.stages.align_depth import align_depth as align_depth
from gscompleter.stages.filter_holes import filter_holes as filter_holes
from gscompleter.stages.hole_masks import compute_hole_mask as compute_hole_mask
from gscompleter.stages.lift import lift as lift
from gscompleter.stages.refine import refine as refine
from gscompleter.stages.register import register_along_rays as register_along_rays
from gscompleter.stages.register_paper import register_as_paper as register_as_paper
from gscompleter.stages.select_anchor import choose_anchor as choose_anchor
from gscompleter.stages.synthesize import make_generator_input as make_generator_input
from gscompleter.stages.synthesize import synthesize as synthesize
from gscompleter.stages.target_view import render_target as render_target
