"""Files by the names that other programs and machines wrote."""

import os
from pathlib import Path

import pytest

from gscompleter.data.file_names import FolderListings, list_endings, locate


def test_a_folder_that_cannot_be_listed_is_entered_under_the_name_it_has(tmp_path, monkeypatch):
    (tmp_path / "Images" / "left").mkdir(parents=True)
    (tmp_path / "Images" / "left" / "a.jpg").touch()
    list_all = os.listdir

    def list_parent(folder: Path) -> list[str]:
        if Path(folder) != tmp_path:
            raise PermissionError
        return list_all(folder)

    monkeypatch.setattr(os, "listdir", list_parent)
    found = FolderListings().find(tmp_path, "images/left/a.jpg")
    assert found == tmp_path / "Images" / "left" / "a.jpg"
    assert FolderListings().find(tmp_path, "images/left/b.jpg") is None


@pytest.mark.parametrize(
    ("written", "endings"),
    [
        ("images/a.jpg", ["images/a.jpg"]),
        ("/home/me/a.jpg", ["home/me/a.jpg", "me/a.jpg", "a.jpg"]),
        (r"C:\data\a.jpg", ["data/a.jpg", "a.jpg"]),
        (r".\images\a.jpg", ["images/a.jpg", "a.jpg"]),
    ],
)
def test_any_end_of_a_path_of_another_machine_may_be_here(written, endings):
    assert list_endings(written) == endings


def test_a_path_is_looked_for_once_as_written_and_by_its_ends():
    asked = []
    assert locate(Path("scene"), "images/a.jpg", asked.append) == Path("scene/images/a.jpg")
    assert asked == [Path("scene/images/a.jpg")]
