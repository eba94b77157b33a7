"""Equations and sections that the code cites have the numbers of the paper."""

import re
from importlib import import_module
from pathlib import Path

import pytest

import gscompleter
from gscompleter.types import DepthAffine

# As names of `gscompleter.stages` they are the functions.
align_paper = import_module("gscompleter.stages.align_paper")
context = import_module("gscompleter.stages.context")
lift = import_module("gscompleter.stages.lift")
refine = import_module("gscompleter.stages.refine")
select_anchor = import_module("gscompleter.stages.select_anchor")
register = import_module("gscompleter.stages.register")
register_paper = import_module("gscompleter.stages.register_paper")
synthesize = import_module("gscompleter.stages.synthesize")
hole_masks = import_module("gscompleter.stages.hole_masks")

EQUATIONS = {
    5: (r"\Psi(\mathcal{V}_{\text{in}}; \Theta)", [context.init_context]),
    6: (r"\Phi(\mathbf{I}_n, \mathbf{P}_t)", [synthesize.synthesize]),
    7: (r"\Psi(\mathcal{V}_{\text{pair}}; \Theta)", [lift.lift_pair]),
    8: (
        r"(s \cdot D_{\text{pred}}^{\text{anc}}",
        [align_paper.compare_at_anchor, align_paper.fit_affine, DepthAffine],
    ),
    9: (r"d_i^{\text{init}} = \frac", [register_paper.initialize_distances, register.apply_affine]),
    10: (
        r"\mathbf{c}_{\text{tgt}} + d_i \cdot \mathbf{r}_i",
        [register_paper.move_on_rays, register.move_along_rays],
    ),
    11: (
        r"\lambda_s \mathcal{L}_{\text{stereo}}",
        [
            register_paper.weigh_losses,
            register_paper.optimize_paper_distances,
            register.Objective,
            register.optimize_distances,
        ],
    ),
    12: (r"\mathbf{A}_{\text{ctx}}(\mathbf{p}) < \tau", [hole_masks.compute_hole_mask]),
    13: (r"\mathcal{L}_{\text{mv}} =", [refine.refine_opacities]),
}
"""For each equation of the paper by number, a piece of it and the code that implements it."""

SECTIONS = {
    "III-C": ("Feed-Forward Metric Context Initialization", [context]),
    "III-D": ("Anchor-Guided Gaussian Initialization", [select_anchor]),
    "III-E": ("Ray-Constrained Gaussian Registration", [align_paper, register_paper, register]),
    "III-F": (r"Multi-View Gaussian Integration \& Refinement", [refine]),
}


@pytest.mark.parametrize("number", EQUATIONS)
def test_who_obeys_an_equation_cites_it_and_no_other(number):
    for cites in EQUATIONS[number][1]:
        assert re.findall(r"Eq\. (\d+)", cites.__doc__) == [str(number)], cites.__name__


@pytest.mark.parametrize("number", SECTIONS)
def test_a_stage_names_its_section(number):
    for stage in SECTIONS[number][1]:
        assert re.findall(r"Sec\. ([IV]+-[A-Z])", stage.__doc__) == [number], stage.__name__


def test_no_other_equation_is_cited_anywhere():
    sources = Path(gscompleter.__file__).parent.rglob("*.py")
    cited = {int(n) for file in sources for n in re.findall(r"Eq\. (\d+)", file.read_text())}
    assert cited == set(EQUATIONS)


def test_the_numbers_are_those_of_the_paper(shared):
    text = (shared / "paper" / "gscompleter.tex").read_text()
    equations = re.findall(r"\\begin\{equation\}(.*?)\\end\{equation\}", text, re.DOTALL)
    for number, (piece, _) in EQUATIONS.items():
        assert piece in equations[number - 1], number
    method = re.findall(r"^\\section\{.*?(?=^\\section\{)", text, re.DOTALL | re.MULTILINE)[2]
    titles = re.findall(r"\\subsection\{(.*)\}", method)
    for number, (title, _) in SECTIONS.items():
        assert titles[ord(number[-1]) - ord("A")] == title
