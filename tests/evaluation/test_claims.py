"""Claims of the paper are judged by paired differences, a t test and a sign test."""

import json
from pathlib import Path

import pytest

from gscompleter.evaluation.claims import CLAIM_COLUMNS, judge_claim, tabulate_claims
from gscompleter.evaluation.paper import Claim, load_paper


def claim(**others: object) -> Claim:
    given = {"model": None, "over_spans": False, "table": "dof", "column": "abs_rel", **others}
    return Claim("-", "2 → 1", method="paper", baseline="paper/no-da-rc", better="lower", **given)


def row(method: str, values: dict[str, float], column: str = "abs_rel", **where: str) -> dict:
    cells = {column: {"value": 1.0, "cases": values}}
    return {"model": "x", "protocol": "", "method": method, "cells": cells, **where}


def save(folder: Path, rows: list[dict], table: str = "dof") -> None:
    (folder / f"{table}.json").write_text(json.dumps({"rows": rows}))


def save_differences(folder: Path, values: tuple[float, ...]) -> None:
    """Write a table in which the method differs from its baseline by these values, by scene."""
    scenes = [f"{letter} 0>1" for letter in "abcdefgh"[: len(values)]]
    ours = {scene: 5 + value for scene, value in zip(scenes, values, strict=True)}
    save(folder, [row("paper", ours), row("paper/no-da-rc", dict.fromkeys(scenes, 5.0))])


@pytest.mark.parametrize(
    ("values", "verdict", "in_favour"),
    [
        ((1.0, 1.1, 0.9), "not reproduced", "0 of 3"),
        ((-1.0, -1.1, -0.9), "reproduced", "3 of 3"),
        ((-1.0, 1.1, 0.0), "within noise", "1 of 3 (1 equal)"),
        ((0.0, 0.0, 0.0), "no difference", "0 of 3 (3 equal)"),
        ((-1.0,), "one scene only", "1 of 1"),
        ((), "not measured", ""),
        # Above two standard errors, but not for three scenes.
        ((-1.0, -2.0, -3.0), "within noise", "3 of 3"),
        # A single huge difference makes the mean noise, while all scenes agree in sign.
        ((-0.1,) * 7 + (-9.0,), "reproduced by signs", "8 of 8"),
        ((0.1,) * 7 + (9.0,), "not reproduced, by signs", "0 of 8"),
        # Nor does a single scene make a claim.
        ((0.1,) * 6 + (-0.1, -9.0), "within noise", "2 of 8"),
    ],
)
def test_a_claim_is_judged_by_the_scenes(values, verdict, in_favour, tmp_path):
    save_differences(tmp_path, values)
    found = judge_claim(tmp_path, claim())
    assert (found.verdict, found.in_favour) == (verdict, in_favour)


def test_a_judgement_says_what_it_rests_on(tmp_path):
    save_differences(tmp_path, (-1.0, -2.0, -3.0, -2.0))
    found = judge_claim(tmp_path, claim())
    # t = -2 / (0.8165 / 2); p of t(3) and of 4 heads in 4 throws, two-sided.
    assert found.measured == "AbsRel -2.0000 ± 0.4082"
    assert found.t_test == "t(3) = -4.90, p = 0.016"
    assert found.sign_test == "p = 0.125"


def test_cases_of_one_scene_count_once(tmp_path):
    ours = {f"a 0>{n}": 4.0 for n in range(20)} | {"b 0>1": 4.0, "c 0>1": 6.5}
    save(tmp_path, [row("paper", ours), row("paper/no-da-rc", dict.fromkeys(ours, 5.0))])
    found = judge_claim(tmp_path, claim())
    assert found.in_favour == "2 of 3"
    assert found.t_test.startswith("t(2)")


def test_a_claim_about_one_model_leaves_the_others_out(tmp_path):
    cases = {"a 0>1": 1.0, "b 0>1": 1.0}
    better = dict.fromkeys(cases, 0.5)
    rows = [row("paper", better, model="x"), row("paper/no-da-rc", cases, model="x")]
    save(tmp_path, rows)
    assert judge_claim(tmp_path, claim(model="x")).in_favour == "2 of 2"
    assert judge_claim(tmp_path, claim(model="volsplat-re10k")).verdict == "not measured"


@pytest.mark.parametrize(("last", "verdict"), [(4.0, "reproduced"), (0.5, "not reproduced")])
def test_a_gain_that_widens_is_compared_within_scenes_between_spans(last, verdict, tmp_path):
    """The gain is 1 at the first span, 9 at the second, and `last` at the third."""
    rows = []
    for span, gain in (("n-2", 1.0), ("n-4", 9.0), ("n-8", last)):
        scenes = {f"{letter} 0>{span}": 20.0 + n for n, letter in enumerate("abc")}
        noise = dict(zip(scenes, (0.0, 0.02, -0.02), strict=True))
        ours = {case: value + gain + noise[case] for case, value in scenes.items()}
        for method, values in (("context", scenes), ("paper", ours)):
            rows.append(row(method, values, "psnr", protocol=span))
    # A scene that only the first span has.
    rows[0]["cells"]["psnr"]["cases"]["d 0>1"] = 20.0
    rows[1]["cells"]["psnr"]["cases"]["d 0>1"] = 90.0
    save(tmp_path, rows, "spans")
    widens = Claim("-", "", "spans", "psnr", "paper", "context", "higher", over_spans=True)
    found = judge_claim(tmp_path, widens)
    assert found.verdict == verdict
    assert found.measured.startswith(f"PSNR {last - 1:+.2f}")


def total(method: str, value: float, protocol: str = "") -> dict:
    cells = {"fid": {"value": value, "cases": None}}
    return {"model": "x", "protocol": protocol, "method": method, "cells": cells}


def test_one_number_for_all_cases_has_no_test(tmp_path):
    rows = [total("paper", 60.95), total("context", 65.21)]
    save(tmp_path, rows, "spans")
    lower = Claim("-", "", "spans", "fid", "paper", "context", "lower")
    assert judge_claim(tmp_path, lower).verdict == "as claimed, without a test"
    higher = Claim("-", "", "spans", "fid", "paper", "context", "higher")
    assert judge_claim(tmp_path, higher).verdict == "opposite, without a test"


def test_one_number_for_all_cases_is_compared_within_a_protocol(tmp_path):
    """A harder span that only the method has is no fault of the method."""
    rows = [total("paper", 60.0, "n-2"), total("context", 65.0, "n-2"), total("paper", 120, "n-4")]
    save(tmp_path, rows, "spans")
    found = judge_claim(tmp_path, Claim("-", "", "spans", "fid", "paper", "context", "lower"))
    assert found.verdict == "as claimed, without a test"
    assert found.measured == "FID -5.00"


def test_one_number_for_all_cases_that_stays_is_no_difference(tmp_path):
    save(tmp_path, [total("paper", 60.0), total("context", 60.0)], "spans")
    found = judge_claim(tmp_path, Claim("-", "", "spans", "fid", "paper", "context", "lower"))
    assert found.verdict == "no difference"


def test_every_claim_of_the_paper_has_a_row(tmp_path):
    claims = load_paper().claims
    rows = tabulate_claims(tmp_path, claims)
    assert all(len(cells) == len(CLAIM_COLUMNS) for cells in rows)
    assert {cells[-1] for cells in rows} == {"not measured"}
    assert len({claim.says for claim in claims}) == len(claims)


@pytest.mark.parametrize(
    ("table", "columns", "baseline"),
    [
        ("ablation", {"psnr", "abs_rel", "chamfer", "f_score"}, "paper/no-sa"),
        ("ablation", {"psnr", "abs_rel", "chamfer", "f_score"}, "paper/no-da"),
        ("ablation", {"abs_rel", "chamfer", "f_score"}, "paper/no-rc"),
        ("ablation", {"psnr", "abs_rel", "chamfer", "f_score"}, "paper/none"),
        ("refinement", {"psnr", "ssim", "context", "context_ssim"}, "paper/no-mv"),
        ("dof", {"psnr", "abs_rel", "chamfer", "f_score"}, "paper/unconstrained"),
        ("alignment", {"psnr", "abs_rel", "chamfer", "f_score"}, "paper/target-aligned"),
        ("stress", {"ssim", "abs_rel", "chamfer", "f_score"}, "paper/no-sa"),
        ("spans", {"psnr", "fid"}, "context"),
        ("paradigms", {"psnr", "hole_psnr", "seconds_register"}, "reggs"),
        ("sequence", {"psnr", "scale_drift", "seconds"}, "reggs"),
    ],
)
def test_no_column_is_chosen_for_its_result(table, columns, baseline):
    """A claim with several numbers in the paper has a row for each, whatever comes out."""
    of = [c for c in load_paper().claims if (c.table, c.baseline) == (table, baseline)]
    assert {c.column for c in of if c.method == "paper"} == columns


def test_pre_registration_is_without_affine_and_without_rays():
    """Table VII: 0.4541 / 3.5541 / 0.4028, which in Table IV is "w/o DA&RC"."""
    assert load_paper().tables["dof"].methods == (
        "paper/no-da-rc", "paper/unconstrained", "paper"
    )  # fmt: skip
