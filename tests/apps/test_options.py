"""Options of all commands: one name has one meaning, and an old one is refused with the new one."""

import pytest

from command import run
from gscompleter.apps.command_line.old_spellings import OLD_SPELLINGS
from gscompleter.apps.command_line.words import list_options
from gscompleter.cli import OptionClasses, parse_command
from gscompleter.system.errors import InputError


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("repair", "splat.ply", "--camera", "camera.json", "--mask", "wrong.png"),
            "repair has no option --camera any more; the cameras of masks are named by --target",
        ),
        (
            ("complete", "room", "--scene", "splat.ply", "--from-photographs-only"),
            "any more; `gscompleter update` adds what photographs show and a splat lacks, and",
        ),
        (("repair", "splat.ply", "--camera=camera.json"), "are named by --target"),
    ],
)
def test_an_old_spelling_is_refused_with_the_new_one(
    words, sentence, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--out", out) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(("command", "name"), OLD_SPELLINGS)
def test_an_old_spelling_is_no_option_of_its_command(command, name):
    assert name not in list_options(OptionClasses()[command])
    with pytest.raises(InputError, match=f"{command} has no option --{name} any more; "):
        parse_command([command, f"--{name.replace('-', '_')}", "x"])
