"""Report pages of completions: content, escaping, and no external requests."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from command import run
from gscompleter.apps.report.page import open_gallery, render_completion_page
from gscompleter.apps.report.plain_words import (
    describe_exposures,
    describe_wanted_photographs,
    list_photograph_notes,
)
from gscompleter.apps.report.record import fit_frame
from gscompleter.apps.report.schema import AlignmentRow, ContextRow, TargetRow, read_summary
from gscompleter.evaluation.verdict.numbers import format_change, format_number, format_percent
from gscompleter.system.errors import InputError
from scenes import camera_at

VOID = {"meta", "img", "input", "link", "br", "hr"}
HOSTILE = '</script><script>alert(1)</script><img src=x onerror="alert(2)">&\''


class Page(HTMLParser):
    """Tags and words of a page; asserts that every tag is closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.words.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    def said(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture
def out(completed_room, tmp_path) -> Path:
    """Return a copy of a completion that tests may change."""
    return Path(shutil.copytree(completed_room, tmp_path / "out"))


def changed(path: Path, change) -> None:
    """Apply `change` to the content of a JSON file."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_the_page_is_well_formed_and_every_target_has_its_slider(completed_room):
    page = Page((completed_room / "report.html").read_text())
    sliders = [i for i in page.all("input") if i["min"] == "0" and i["max"] == "100"]
    assert len(sliders) == 1
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert "target1" in ids
    assert len(ids) == len(set(ids))


def test_the_page_asks_for_nothing_and_runs_only_its_own_script(completed_room):
    text = (completed_room / "report.html").read_text()
    page = Page(text)
    assert re.search(r"https?:|(src|href|action|data)=[\"']?//|url\(|@import", text) is None
    assert all(image["src"].startswith("data:image/") for image in page.all("img"))
    assert len(page.all("script")) == 1
    assert page.all("link") == page.all("iframe") == page.all("object") == []
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    (policy,) = [m["content"] for m in page.all("meta") if "http-equiv" in m]
    assert policy.startswith("default-src 'none'; img-src data:")


def test_everything_has_a_name_for_those_who_do_not_see_it(completed_room):
    text = (completed_room / "report.html").read_text()
    page = Page(text)
    assert all(image["alt"] for image in page.all("img"))
    assert len(page.all("svg")) == len(re.findall(r"<svg [^>]*><title>[^<]+</title><desc>", text))
    assert len(page.all("label")) == len(page.all("input"))
    assert len(page.all("caption")) == len(page.all("table")) > 1
    assert all(head["scope"] in ("col", "row") for head in page.all("th"))


def test_what_summary_json_has_is_on_the_page(completed_room):
    said = Page((completed_room / "report.html").read_text()).said()
    summary = json.loads((completed_room / "summary.json").read_text())
    (row,) = summary["targets"]
    expected = (
        f"{row['psnr_before']:.2f} → {row['psnr_after']:.2f} dB",
        f"{100 * row['hole_fraction']:.1f} %",
        f"{row['added']:,}",
        f"{100 * summary['coverage']['after']:.1f} %",
        f"scene depth = {row['affine']['scale']:.3f} × lifted depth",
        '"registration": { "iterations"',
        # After one pose and one gain of the target's camera were fitted to its photograph.
        f"PSNR, camera fitted {row['fitted']['psnr']:.2f} dB",
        f"Target 1: moved by {row['fitted']['moved']:.2f} px",
    )
    assert [text for text in expected if text not in said] == []


def test_the_errors_of_a_targets_camera_are_taken_out_of_a_second_score(completed_room):
    (row,) = json.loads((completed_room / "summary.json").read_text())["targets"]
    # Whatever a pose and a gain gain outside of holes, they lose nothing there.
    assert row["fitted"]["observed_psnr"] > row["psnr_after"]
    assert 0 <= row["fitted"]["moved"] < 5
    assert row["fitted"]["gain"] == pytest.approx(1, abs=0.1)


def test_the_same_folder_gives_the_same_bytes(completed_room, out, monkeypatch, capsys):
    written = (completed_room / "report.html").read_bytes()
    assert render_completion_page(completed_room).encode() == written
    (out / "report.html").unlink()
    assert run(monkeypatch, "report", out) == 0
    assert (out / "report.html").read_bytes() == written
    assert capsys.readouterr().out == f"{out / 'report.html'}\n"


def test_page_and_record_are_small(completed_room):
    assert 30_000 < (completed_room / "report.html").stat().st_size < 1_000_000
    assert (completed_room / "report.json").stat().st_size < 200_000


def test_hostile_words_are_words(out):
    def poison(summary):
        summary["settings"]["folder"] = f"/data/{HOSTILE.replace('/', '|')}"
        summary["settings"][HOSTILE] = HOSTILE
        summary["targets"][0]["notes"] = [HOSTILE]
        summary["targets"][0]["affine"]["method"] = HOSTILE
        summary["scene"]["format"] = summary["device"] = HOSTILE
        summary["seconds"][HOSTILE] = 1.0

    changed(out / "summary.json", poison)
    text = render_completion_page(out)
    page = Page(text)
    assert len(page.all("script")) == 1
    assert not any("onerror" in image for image in page.all("img"))
    assert HOSTILE not in text
    assert page.said().count("<script>alert(1)</script>") >= 4


@pytest.mark.parametrize("nothing", [None, float("nan"), float("inf")])
def test_numbers_that_are_none_are_dashes(out, nothing):
    def forget(summary):
        row = summary["targets"][0]
        row.update({key: nothing for key in row if key.startswith(("psnr", "ssim"))})
        row["affine"]["agreement"] = None
        summary["context"][0]["psnr_after"] = nothing

    changed(out / "summary.json", forget)
    said = Page(render_completion_page(out)).said()
    # Without any score there is no table.
    assert ("1: photograph 2 (2.png) – – – – – –" in said) is (nothing is not None)
    shown = said.split("All settings")[0].replace("–", "")
    assert re.search(r"\b(nan|inf|None|null)\b", shown) is None


def test_numbers_in_words():
    assert [format_number(v) for v in (1.234, None, float("nan"), float("inf"))] == [
        "1.23",
        "–",
        "–",
        "–",
    ]
    assert [format_percent(v) for v in (0.125, None)] == ["12.5 %", "–"]
    assert [
        format_change(2.0, 3.0),
        format_change(3.0, 2.0),
        format_change(1.0, 0.9999),
        format_change(None, 2.0),
    ] == [
        "+1.00",
        "-1.00",
        "+0.00",
        "–",
    ]


@pytest.mark.parametrize("content", [None, b"no image"])
def test_a_missing_or_damaged_image_is_told(out, content):
    image = out / "images" / "target1_after.png"
    image.unlink()
    if content is not None:
        image.write_bytes(content)
    with pytest.raises(InputError, match="target1_after.png"):
        render_completion_page(out)


def test_of_a_given_splat_the_trusted_share_is_said(out):
    changed(out / "summary.json", lambda summary: summary["gaussians"].update(recolored=0))
    coverage = json.loads((out / "summary.json").read_text())["coverage"]
    shares = f"{100 * coverage['before']:.1f} % before, {100 * coverage['after']:.1f} % after."
    assert f"Trusted around the photographs: {shares}" in Page(render_completion_page(out)).said()


def test_a_completion_without_targets_says_so(out):
    changed(out / "summary.json", lambda summary: summary.update(targets=[]))
    changed(out / "report.json", lambda kept: kept.update(targets=[], pairs=[], photographs=[]))
    said = Page(render_completion_page(out)).said()
    assert "targets 0" in said
    assert "At the targets" not in said


def test_the_viewer_is_linked_where_there_is_one(out):
    assert "gscompleter view OUT" in Page(render_completion_page(out)).said()
    (out / "view.html").write_text("")
    links = [link["href"] for link in Page(render_completion_page(out)).all("a")]
    assert links == [
        *("view.html#camera=target-1", "view.html#camera=target-1&play=1", "view.html"),
    ]


def broken_json(out: Path) -> None:
    (out / "summary.json").write_text("{")


def a_list(out: Path) -> None:
    (out / "summary.json").write_text("[]")


def wrong_type(out: Path) -> None:
    changed(out / "summary.json", lambda s: s["targets"][0].update(hole_fraction="much"))


def no_summary(out: Path) -> None:
    (out / "summary.json").unlink()


def no_record(out: Path) -> None:
    (out / "report.json").unlink()


def other_record(out: Path) -> None:
    changed(out / "report.json", lambda kept: kept["targets"].append(kept["targets"][0]))


def no_folder(out: Path) -> None:
    shutil.rmtree(out)


def a_file(out: Path) -> None:
    shutil.rmtree(out)
    out.write_text("")


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (broken_json, "is not JSON"),
        (a_list, "is damaged"),
        (wrong_type, "is damaged (targets.0.hole_fraction"),
        (no_summary, "has no summary.json"),
        (no_record, "has no report.json"),
        (other_record, "does not fit summary.json"),
        (no_folder, "has no summary.json"),
        (a_file, "has no summary.json"),
    ],
)
def test_what_is_no_result_is_refused_in_a_sentence(out, monkeypatch, capsys, damage, sentence):
    before = None if not (out / "report.html").exists() else (out / "report.html").read_bytes()
    damage(out)
    assert run(monkeypatch, "report", out) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.startswith("gscompleter: ")
    assert said.count("\n") == 1
    if (out / "report.html").exists():
        assert (out / "report.html").read_bytes() == before


def test_notes_of_a_target_are_shown_and_nothing_added_is_said(out):
    rained = ["It rained."]
    changed(out / "summary.json", lambda s: s["targets"][0].update(added=0, notes=rained))
    said = Page(render_completion_page(out)).said()
    assert said.count("It rained.") == 1  # among the facts
    assert "Nothing was added here." in said
    changed(out / "summary.json", lambda s: s["targets"][0].update(warnings=rained))
    said = Page(render_completion_page(out)).said()
    assert said.count("It rained.") == 1
    assert "Nothing was added here." not in said


@pytest.mark.parametrize(
    ("method", "sentence"),
    [
        ("ransac", "RANSAC fits scene depth"),
        ("median", "The median depth ratio is used"),
        ("identity", "The lifted depths are used unchanged."),
    ],
)
def test_the_fit_of_the_depths_is_said(out, method, sentence):
    fit = {"method": method, "agreement": None}
    changed(out / "summary.json", lambda s: s["targets"][0]["affine"].update(fit))
    assert sentence in Page(render_completion_page(out)).said()


def test_pages_stay_small(tmp_path):
    Image.new("L", (8, 8)).save(tmp_path / "small.png")
    assert open_gallery(tmp_path).scale == 1
    Image.new("L", (6000, 4000)).save(tmp_path / "large.png")
    large = open_gallery(tmp_path).embed("large", "")
    assert 11e6 < large.width * large.height < 12.1e6


def test_the_record_keeps_what_the_affine_was_fitted_to(completed_room):
    kept = json.loads((completed_room / "report.json").read_text())
    (affine,) = [
        t["affine"] for t in json.loads((completed_room / "summary.json").read_text())["targets"]
    ]
    points = np.array(kept["pairs"][0]["points"])
    x, y, agrees = points[:, 0], points[:, 1], points[:, 2] == 1
    assert 100 < len(x) == len(y) == len(agrees) <= 1000
    residual = np.abs(affine["scale"] * x + affine["shift"] - y)
    assert (residual[agrees] < 0.0501 * y[agrees]).all()
    assert (residual[~agrees] > 0.0499 * y[~agrees]).all()
    assert agrees.mean() == pytest.approx(affine["inliers"], abs=0.05)
    assert len(kept["photographs"]) == 3


def test_depth_pairs_are_drawn_in_a_unit_square(out):
    points = [(1, 2, True), (2, 4, True), (3, 5, False)]
    changed(out / "report.json", lambda kept: kept["pairs"][0].update(points=points))
    text = render_completion_page(out)
    assert '<path class="inlier" d="M0.2000 0.4000h0M0.4000 0.8000h0"/>' in text
    assert '<path class="outlier" d="M0.6000 1.0000h0"/>' in text


def test_the_drawing_stands_upright():
    cameras = [camera_at(), camera_at(1.0, yaw=180)]
    frame = fit_frame(cameras)
    assert torch.allclose(frame.axes[1], torch.tensor([0.0, -1.0, 0.0]))  # y points down
    assert torch.allclose(frame.axes @ frame.axes.T, torch.eye(3), atol=1e-6)
    assert torch.linalg.det(frame.axes) > 0
    assert frame.convert(torch.stack([c.center for c in cameras])).norm(dim=1).max() <= 1


def test_that_something_moved_is_told_with_where(completed_room):
    summary, scores = read_summary(completed_room), [None] * 4
    still = tuple(ContextRow(frame, *scores) for frame in (7, 15))
    assert list(list_photograph_notes(replace(summary, context=still))) == []
    rows = [
        ContextRow(frame, *scores, dynamic_fraction=share)
        for frame, share in ((7, 0.0155), (15, 0.0), (23, 0.006))
    ]
    (said,) = list_photograph_notes(replace(summary, context=tuple(rows)))
    assert "1.6 % of photograph 7, 0.6 % of photograph 23" in said.text


@pytest.mark.parametrize(
    ("format", "said"),
    [
        ("colmap", "the depth of COLMAP's points, which"),
        ("photographs", "the depth of COLMAP's points, which"),
        ("nerfstudio", "a measured or predicted depth, which"),
    ],
)
def test_a_known_depth_is_told_with_its_source(completed_room, format, said):
    summary = read_summary(completed_room)
    row = ContextRow(7, *[None] * 4, given_depth=0.014)
    scene = replace(summary.scene, format=format)
    (note,) = list_photograph_notes(replace(summary, scene=scene, context=(row, row)))
    assert note.text.startswith(f"Up to 1.4 % of a photograph's pixels have {said}")


def test_depth_maps_beside_a_colmap_model_are_no_points(completed_room):
    summary = read_summary(completed_room)
    row = ContextRow(7, *[None] * 4, given_depth=0.9)
    notes = ("4 of 4 photographs have inverse depth of 3DGS (depth_params.json).",)
    scene = replace(summary.scene, format="colmap", notes=notes)
    (note,) = list_photograph_notes(replace(summary, scene=scene, context=(row,)))
    assert "have a measured or predicted depth, which" in note.text


def test_exposures_are_compared_by_channel():
    said = describe_exposures([(1.2, 1.0, 0.5), (0.8, 1.0, 0.5)])
    assert "differ by a factor of up to 1.50; the scene has one exposure" in said
    # A remade scene keeps the exposure of an earlier one, which all photographs differ from alike.
    said = describe_exposures([(0.8, 1.0, 1.25)] * 2)
    assert said.startswith("The scene has another exposure than the context photographs, at which")


def test_what_is_ignored_is_told_with_its_cause(completed_room):
    summary = read_summary(completed_room)
    hidden = replace(summary, context=(ContextRow(7, *[None] * 4, ignored=0.25),))
    (said,) = list_photograph_notes(hidden)
    assert "Up to 25.0 % of a photograph is hidden by a mask, or stays the same" in said.text
    removed = replace(hidden, gaussians={**hidden.gaussians, "removed": 3})
    (said,) = list_photograph_notes(removed)
    assert (
        "Up to 25.0 % of a photograph shows what was removed, or is hidden by a mask;" in said.text
    )
    assert "bonnet" not in said.text


def test_where_to_stand_for_new_photographs():
    scores, alignment = [None] * 4, AlignmentRow(1.0, 0.0, 0.0, "identity")
    rows = [
        TargetRow(None, *scores, 0, False, 0.1, alignment, 0, derived_from=frame)
        for frame in (12, 31, 5)
    ]
    assert "beside photograph 12 and photograph 31" in describe_wanted_photographs(rows)
    assert "--target" in describe_wanted_photographs([])
