"""Verdicts on the claims of the paper, from the tables of a reproduction.

A claim compares two methods in a column. Differences are paired by case, and cases of one scene
count as one observation. Two tests stand beside each other: Student's t of the mean over scenes,
which one scene with a huge difference can hide or make, and the sign test, which only counts the
scenes in favour.
"""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from gscompleter.evaluation.columns import BY_KEY, Column
from gscompleter.evaluation.paper import Claim
from gscompleter.evaluation.paper_tables import SIGNIFICANCE, Estimate, estimate_mean, get_scene
from gscompleter.evaluation.store import read_run_file

CLAIM_COLUMNS = (
    "claim",
    "the paper",
    "table",
    "measured",
    "t test",
    "in favour",
    "sign test",
    "verdict",
)
"""Titles of the columns of a table of claims."""

Rows = list[Mapping[str, Any]]
"""Rows of a table's JSON file, each with `model`, `protocol`, `method` and `cells`."""


@dataclass(frozen=True)
class Signs:
    """Scenes whose mean difference is in favour of a claim, against it, or zero."""

    in_favour: int
    against: int
    equal: int

    @property
    def p_value(self) -> float:
        """Two-sided p of the sign test, which leaves out scenes without a difference."""
        count = self.in_favour + self.against
        return float(binomtest(self.in_favour, count).pvalue) if count else 1.0

    def describe(self) -> str:
        """Return `7 of 8`, with the number of scenes without a difference if there are any."""
        equal = f" ({self.equal} equal)" if self.equal else ""
        return f"{self.in_favour} of {self.in_favour + self.against + self.equal}{equal}"


@dataclass(frozen=True)
class Judgement:
    """A verdict with what it rests on, as texts for a table."""

    verdict: str
    measured: str = ""
    t_test: str = ""
    in_favour: str = ""
    sign_test: str = ""


def tabulate_claims(folder: Path, claims: Iterable[Claim]) -> list[list[str]]:
    """Judge the claims by the tables in a folder; return a row for each, below `CLAIM_COLUMNS`."""
    rows = []
    for claim in claims:
        judgement = judge_claim(folder, claim)
        rows.append(
            [
                claim.says,
                claim.paper,
                claim.table,
                judgement.measured,
                judgement.t_test,
                judgement.in_favour,
                judgement.sign_test,
                judgement.verdict,
            ]
        )
    return rows


def judge_claim(folder: Path, claim: Claim) -> Judgement:
    """Judge a claim by the table in a folder."""
    path = folder / f"{claim.table}.json"
    rows: Rows = list(read_run_file(path)["rows"]) if path.is_file() else []
    if claim.model is not None:
        rows = [row for row in rows if row["model"] == claim.model]
    column = BY_KEY[claim.column]
    sign = 1 if claim.better == "higher" else -1
    differences = compare_spans(rows, claim) if claim.over_spans else compare_rows(rows, claim)
    # FID and the like are of all images at once: there are no cases to pair.
    if not differences:
        return compare_totals(rows, claim, column, sign)
    return judge_differences(differences, column, sign)


def judge_differences(differences: Mapping[str, float], column: Column, sign: int) -> Judgement:
    """Judge paired differences by case; `sign` is 1 if the claim wants them positive, else -1."""
    estimate = estimate_mean(differences)
    signs = count_signs(differences, sign)
    measured = f"{column.title} {estimate.mean:+.{column.digits}f}"
    if estimate.error is None:
        return Judgement("one scene only", measured, in_favour=signs.describe())
    measured += f" ± {estimate.error:.{column.digits}f}"
    if signs.in_favour == signs.against == 0:
        return Judgement("no difference", measured, in_favour=signs.describe())
    return Judgement(
        choose_verdict(estimate, signs, sign),
        measured,
        describe_t_test(estimate),
        signs.describe(),
        describe_p(signs.p_value),
    )


def choose_verdict(estimate: Estimate, signs: Signs, sign: int) -> str:
    """Choose the verdict: by the t test, or else by the signs, or else noise."""
    if not estimate.is_noise:
        return "reproduced" if sign * estimate.mean > 0 else "not reproduced"
    if signs.p_value <= SIGNIFICANCE:
        is_favourable = signs.in_favour > signs.against
        return "reproduced by signs" if is_favourable else "not reproduced, by signs"
    return "within noise"


def describe_t_test(estimate: Estimate) -> str:
    """Return the statistic with its degrees of freedom and its p."""
    assert estimate.error is not None
    statistic = f"t({estimate.degrees_of_freedom})"
    if estimate.error > 0:
        statistic += f" = {estimate.mean / estimate.error:.2f}"
    return f"{statistic}, {describe_p(estimate.p_value)}"


def describe_p(value: float) -> str:
    """Format a p value."""
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def count_signs(differences: Mapping[str, float], sign: int) -> Signs:
    """Count the scenes by the sign of their mean difference."""
    means = [sign * mean for mean in average_scenes(differences).values()]
    in_favour = sum(mean > 0 for mean in means)
    against = sum(mean < 0 for mean in means)
    return Signs(in_favour, against, len(means) - in_favour - against)


def average_scenes(values: Mapping[str, float]) -> dict[str, float]:
    """Average the values of the cases of each scene."""
    scenes: dict[str, list[float]] = defaultdict(list)
    for case, value in values.items():
        scenes[get_scene(case)].append(value)
    return {scene: statistics.fmean(of) for scene, of in scenes.items()}


def compare_rows(rows: Rows, claim: Claim) -> dict[str, float]:
    """Return method minus baseline for the cases that both have, of all models and protocols."""
    values: dict[str, dict[str, float]] = {claim.method: {}, claim.baseline: {}}
    for row in rows:
        if row["method"] in values:
            cases = row["cells"][claim.column]["cases"] or {}
            # A case occurs in several models and protocols, where it is another case.
            where = f"|{row['model']}|{row['protocol']}"
            values[row["method"]] |= {case + where: value for case, value in cases.items()}
    others = values[claim.baseline]
    return {c: v - others[c] for c, v in values[claim.method].items() if c in others}


def compare_spans(rows: Rows, claim: Claim) -> dict[str, float]:
    """Return the growth of method minus baseline from the first protocol to the last, by scene.

    Cases of different spans have different frames, so that scenes are paired instead.
    """
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    if len(protocols) < 2:
        return {}

    def average_protocol(name: str) -> dict[str, float]:
        differences = compare_rows([row for row in rows if row["protocol"] == name], claim)
        return average_scenes(differences)

    first = average_protocol(protocols[0])
    last = average_protocol(protocols[-1])
    # `get_scene` takes the scene from the name of a case, so that these names need a last word.
    return {f"{scene} -": last[scene] - value for scene, value in first.items() if scene in last}


def compare_totals(rows: Rows, claim: Claim, column: Column, sign: int) -> Judgement:
    """Judge a column with one number for all cases, such as FID; it has no error and no test.

    The difference is averaged over the models and protocols that have both methods: means over
    different ones would compare these, and not the methods.
    """
    ours = find_totals(rows, claim.method, claim.column)
    theirs = find_totals(rows, claim.baseline, claim.column)
    differences = [value - theirs[place] for place, value in ours.items() if place in theirs]
    if not differences or claim.over_spans:
        return Judgement("not measured")
    difference = statistics.fmean(differences)
    measured = f"{column.title} {difference:+.{column.digits}f}"
    if difference == 0:
        return Judgement("no difference", measured)
    verdict = "as claimed" if sign * difference > 0 else "opposite"
    return Judgement(f"{verdict}, without a test", measured)


def find_totals(rows: Rows, method: str, key: str) -> dict[tuple[str, str], float]:
    """Find the numbers of a method that belong to no single case, by model and protocol."""
    totals = {}
    for row in rows:
        cell = row["cells"][key]
        if row["method"] == method and cell["cases"] is None and cell["value"] is not None:
            totals[row["model"], row["protocol"]] = cell["value"]
    return totals
