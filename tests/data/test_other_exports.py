"""Camera files of other programs are refused, with advice on the export to choose."""

from pathlib import Path

import pytest

from command import run
from gscompleter import InputError, load_cameras
from gscompleter.data.formats import open_photographs
from pose_files import write_camera_list, write_photographs

METASHAPE = '<?xml version="1.0"?>\n<document version="2.0.0">\n  <chunk label="1"><sensors/>'
REALITYSCAN = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n0.png,1,2,3,4,5,6\n"
EXPORTS = {
    "cameras.xml": (METASHAPE, "cameras of Metashape"),
    "project.PSX": ('<document version="1.2.0" path="{projectname}.files"/>', "since 2.2"),
    "cameras.csv": (REALITYSCAN, "export its registration as COLMAP"),
    "internal.csv": ("\ufeff#cameras 3\n" + REALITYSCAN, "cameras of RealityScan"),
}


def written(scene: Path, name: str) -> Path:
    """Write the camera file into a folder of photographs."""
    write_photographs(scene / "keyframes" / "images")
    (scene / name).parent.mkdir(parents=True, exist_ok=True)
    (scene / name).write_text(EXPORTS[name][0], encoding="utf-8")
    return scene / name


@pytest.mark.parametrize("name", EXPORTS)
def test_a_folder_with_it_is_refused_though_it_has_photographs(tmp_path, monkeypatch, capsys, name):
    written(tmp_path / "room", name)
    words = ("--context", 0, 1, "--target", 2, "--out", tmp_path / "out")
    assert run(monkeypatch, "complete", tmp_path / "room", *words) == 2
    said = capsys.readouterr().err
    assert EXPORTS[name][1] in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", EXPORTS)
def test_the_file_itself_is_refused_as_a_scene_and_as_a_target(tmp_path, name):
    path = written(tmp_path, name)
    for read in (open_photographs, load_cameras):
        with pytest.raises(InputError, match=EXPORTS[name][1]):
            read(path)


def test_other_tables_and_documents_beside_photographs_say_nothing(tmp_path):
    written(tmp_path, "cameras.xml")
    write_camera_list(tmp_path / "keyframes" / "cameras.json")
    assert len(open_photographs(tmp_path / "keyframes")) == 5
    (tmp_path / "notes.csv").write_text("name,x,y\n")
    with pytest.raises(InputError, match="no posed photographs"):
        open_photographs(tmp_path / "notes.csv")
