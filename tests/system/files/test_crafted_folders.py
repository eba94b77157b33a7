"""An output folder from elsewhere (an archive, a repository) changes nothing outside of it.

Each folder here looks as if a run was killed while it replaced results. Beside it lies a home whose
files are the user's.
"""

import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from gscompleter import InputError
from gscompleter.system.files.output_folder import check_output, read_command, read_listing
from gscompleter.system.files.unfinished import digest_target

pytestmark = pytest.mark.linux

MINE = {"thesis.tex": "mine", ".bashrc": "mine"}


class Crafted:
    """An output folder `results` with what a killed run seems to have left in it."""

    def __init__(self, place: Path) -> None:
        self.home = place / "home"
        self.out = place / "results"
        name = f".gscompleter-{digest_target('results')}-deadbeef-4242-777-0123abcd"
        self.draft = self.out / name
        self.replaced = self.out / f"{name}.old"
        self.home.mkdir()
        for file, text in MINE.items():
            (self.home / file).write_text(text)
        self.draft.mkdir(parents=True)
        self.replaced.mkdir()

    def write(self, folder: Path, *names: str, listed: tuple[str, ...] | None = None) -> None:
        """Write files of a stranger, and a summary that lists them, or other names."""
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text("theirs")
        files = [*(names if listed is None else listed), "summary.json"]
        content = {"program": "gscompleter", "format": 1, "command": "complete", "files": files}
        (folder / "summary.json").write_text(json.dumps(content))

    def expire(self) -> None:
        """Let both folders have given no sign for long."""
        for path in (self.draft, self.replaced):
            os.utime(path, (1, 1), follow_symlinks=False)


def link_of_our_prefix(it: Crafted) -> None:
    it.write(it.draft, ".gscompleter-z/.bashrc", ".gscompleter-z/thesis.tex")
    (it.out / ".gscompleter-z").symlink_to("../home")


def link_of_images(it: Crafted) -> None:
    it.write(it.draft, "images/thesis.tex")
    (it.out / "images").symlink_to("../home")


def old_folder_is_a_link(it: Crafted) -> None:
    it.write(it.draft, "completed.ply")
    it.write(it.out, "thesis.tex", ".bashrc")
    it.replaced.rmdir()
    it.replaced.symlink_to("../home")


def draft_is_a_link(it: Crafted) -> None:
    it.write(it.home, listed=("thesis.tex", ".bashrc"))
    (it.draft).rmdir()
    it.draft.symlink_to("../home")


def link_in_the_old_folder(it: Crafted) -> None:
    it.write(it.draft, "completed.ply")
    it.write(it.out, "images/thesis.tex", "images/letter.tex")
    (it.replaced / "images").symlink_to("../../home")


def link_in_the_draft(it: Crafted) -> None:
    it.write(it.draft, listed=("images/thesis.tex", "images/.bashrc"))
    (it.draft / "images").symlink_to("../../home")


def file_in_the_draft_is_a_link(it: Crafted) -> None:
    it.write(it.draft, listed=("report.html",))
    (it.draft / "report.html").symlink_to("../../home/thesis.tex")


def file_that_the_draft_does_not_list(it: Crafted) -> None:
    it.write(it.draft, "completed.ply", "thesis.tex", listed=("completed.ply",))
    (it.out / "thesis.tex").write_text("mine")


def names_that_lead_out(it: Crafted) -> None:
    it.write(it.draft, "completed.ply", listed=("completed.ply", "../home/thesis.tex"))
    it.write(it.replaced, listed=("../home/thesis.tex", "../home/.bashrc"))


def file_of_the_user_in_the_way(it: Crafted) -> None:
    it.write(it.draft, "thesis.tex")
    (it.out / "thesis.tex").write_text("mine")


def file_of_the_user_that_replaced_an_old_one(it: Crafted) -> None:
    it.write(it.draft, "thesis.tex")
    it.write(it.replaced, "thesis.tex")
    (it.out / "thesis.tex").write_text("mine")


def summary_of_another_program(it: Crafted) -> None:
    it.write(it.draft, "completed.ply")
    content = {"version": "3.1", "files": ["summary.json", "thesis.tex"]}
    (it.out / "summary.json").write_text(json.dumps(content))
    (it.out / "thesis.tex").write_text("mine")


def pipe_in_the_draft(it: Crafted) -> None:
    it.write(it.draft, listed=("report.html",))
    os.mkfifo(it.draft / "report.html")


def later_version(it: Crafted) -> None:
    it.write(it.draft, "completed.ply")
    content = json.loads((it.draft / "summary.json").read_text())
    (it.draft / "summary.json").write_text(json.dumps({**content, "format": 99}))


REFUSED = {
    link_of_our_prefix: "is in the way of a result|is nothing that a killed run leaves",
    link_of_images: "images is in the way of a result",
    old_folder_is_a_link: "is no folder that a run of yours left",
    draft_is_a_link: "is no folder that a run of yours left",
    link_in_the_old_folder: "is nothing that a killed run leaves",
    link_in_the_draft: "is a link or no file, which no run leaves",
    file_in_the_draft_is_a_link: "is a link or no file, which no run leaves",
    file_that_the_draft_does_not_list: "is nothing that a killed run leaves",
    file_of_the_user_in_the_way: "thesis.tex is in the way of a result",
    file_of_the_user_that_replaced_an_old_one: "thesis.tex is in the way of a result",
    pipe_in_the_draft: "is a link or no file, which no run leaves",
    later_version: "later version of gscompleter \\(format 99, this one reads up to 1\\); update",
}
"""What is said of each kind, with `--overwrite`."""
HARMLESS = (names_that_lead_out, summary_of_another_program)
"""Kinds that are finished, as far as they stay in the folder and name what a run wrote."""


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("make", [*REFUSED, *HARMLESS])
def test_what_a_killed_run_seems_to_have_left_changes_nothing_of_the_user(
    tmp_path: Path, make: Callable[[Crafted], None], overwrite: bool
) -> None:
    it = Crafted(tmp_path)
    make(it)
    it.expire()
    home, shown = read_files(it.home), read_files(it.out)
    if make in REFUSED and overwrite:
        with pytest.raises(InputError, match=REFUSED[make]) as error:
            check_output(it.out, overwrite)
        assert len(f"{error.value}\n".splitlines()) == 1
    else:
        with suppress(InputError):
            check_output(it.out, overwrite)
    assert read_files(it.home) == home
    # What the user put into the folder stays as well.
    assert shown.items() <= read_files(it.out).items()


def test_a_folder_that_looks_empty_says_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "out" / ".gscompleter-z").mkdir(parents=True)
    with pytest.raises(InputError, match=r"is not empty \(it holds .gscompleter-z\)"):
        check_output(tmp_path / "out")


def test_what_a_run_completed_before_it_was_killed_is_not_overwritten_unasked(
    tmp_path: Path,
) -> None:
    """All old files had made way, so that the folder looks empty; the new ones are results."""
    it = Crafted(tmp_path)
    it.write(it.draft, "completed.ply")
    it.write(it.replaced, "completed.ply")
    it.expire()
    with pytest.raises(InputError, match="is not empty; .* overwrite"):
        check_output(it.out)
    assert sorted(os.listdir(it.out)) == ["completed.ply", "summary.json"]


@pytest.mark.parametrize(
    "content",
    [
        {"files": ["summary.json", "mine.txt"]},
        {"files": ["summary.json", "mine.txt"], "version": "3.1", "command": "tar"},
        {"files": ["summary.json", "mine.txt"], "command": ["complete"]},
        {"files": ["summary.json", "mine.txt"], "program": "other", "format": 1},
        {"poses": 1, "photographs": 3},
        {"gaussians": {"given": 1, "kept": 1, "removed": 0}},
    ],
)
def test_a_summary_of_another_program_lists_nothing(tmp_path: Path, content: object) -> None:
    (tmp_path / "summary.json").write_text(json.dumps(content))
    (tmp_path / "mine.txt").write_text("mine")
    assert read_listing(tmp_path) == frozenset()
    assert read_command(tmp_path) is None


def read_files(folder: Path) -> dict[str, str]:
    """Read the files of a folder that `ls -A` shows, those of our prefix left out."""
    paths = (path for path in folder.iterdir() if not path.name.startswith(".gscompleter-"))
    return {path.name: path.read_text() for path in paths if path.is_file()}
