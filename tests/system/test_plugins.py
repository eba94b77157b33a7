"""Packages add reconstructors and generators by name, through entry points."""

import sys
from importlib.metadata import distributions

import pytest

from gscompleter import InputError, load_generator, load_reconstructor
from gscompleter.reconstructors import RECONSTRUCTORS
from gscompleter.system.plugins import load_plugins


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Install a package with one Ψ and one Φ."""
    (tmp_path / "mine.py").write_text(
        "def psi(views): ...\n"
        "class Phi:\n"
        "    supports_padding, max_batch_size = True, 1\n"
        "    def synthesize(self, requests): return []\n"
        "PSI = {'my-psi': lambda weights, device: psi}\n"
        "PHI = {'my-phi': lambda settings, seed, photographs, device: Phi()}\n"
    )
    info = tmp_path / "mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Name: mine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[gscompleter.reconstructors]\nmine = mine:PSI\n[gscompleter.generators]\nmine = mine:PHI\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    load_plugins.cache_clear()
    yield
    load_plugins.cache_clear()


@pytest.mark.usefixtures("package")
def test_models_of_another_package_are_found_by_name():
    assert "mine" in {found.metadata["Name"] for found in distributions()}
    assert load_reconstructor("my-psi").__name__ == "psi"
    assert load_generator("my-phi").synthesize([]) == []


@pytest.mark.usefixtures("package")
def test_a_name_that_nobody_has_is_refused_with_all_that_there_are():
    with pytest.raises(InputError, match=", ".join([*RECONSTRUCTORS, "my-psi", "mvsplat-re10k"])):
        load_reconstructor("your-psi")
    with pytest.raises(InputError, match=r"warp-inpaint, oracle, .*my-phi"):
        load_generator("your-phi")
