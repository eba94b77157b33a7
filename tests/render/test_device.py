"""The choice of devices, on machines with and without a GPU, nvcc and gsplat."""

from __future__ import annotations

import logging
import runpy
import sys
from pathlib import Path

import pytest
import torch
from torch.utils import cpp_extension

from gscompleter.render import device, gsplat_kernels
from gscompleter.render.device import Devices, _warn_of_cpu, choose_device, choose_devices
from gscompleter.render.gsplat_kernels import explain_missing_renderer
from gscompleter.render.loading import load_renderer
from gscompleter.system.errors import InputError

WITHOUT_NVCC = "_C = None"
"""What gsplat's module of kernels holds where it found no nvcc."""
COMPILED = "_C = object()"
BROKEN_COMPILER = "raise ImportError('gsplat_cuda.so: cannot open shared object file')"


def forget() -> None:
    """Forget what was tried and said before, and modules that a test put in place of gsplat."""
    explain_missing_renderer.cache_clear()
    _warn_of_cpu.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "gsplat"]:
        del sys.modules[name]


@pytest.fixture(autouse=True)
def fresh():
    forget()
    yield
    forget()


@pytest.fixture
def gpu(monkeypatch):
    """Make torch see a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


def install_gsplat(folder: Path, kernels: str, monkeypatch) -> None:
    """Put a package gsplat on the path whose module of kernels runs one statement."""
    package = folder / "gsplat" / "cuda"
    package.mkdir(parents=True)
    for part in (package.parent, package):
        (part / "__init__.py").write_text("")
    (package / "_backend.py").write_text(kernels + "\n")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(folder / "extensions"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_cuda_is_refused_and_auto_is_the_cpu(caplog):
    assert choose_device("auto") == "cpu"
    assert choose_devices("auto") == Devices("cpu", "cpu")
    # Nothing is missed where there is no GPU.
    assert not caplog.records
    with pytest.raises(InputError, match="cannot draw: torch") as refused:
        choose_device("cuda")
    assert "--renderer-device" not in str(refused.value)
    with pytest.raises(InputError, match="cannot draw"):
        load_renderer("cuda")
    with pytest.raises(InputError, match="networks cannot run on cuda"):
        choose_devices("cpu", networks="cuda")


@pytest.mark.skipif(torch.backends.mps.is_available(), reason="there is a GPU of a Mac")
def test_a_mac_that_is_none_is_refused():
    with pytest.raises(InputError, match="no GPU of a Mac; choose cpu"):
        choose_devices("cpu", networks="mps")
    with pytest.raises(InputError, match="no GPU of a Mac; choose cpu") as refused:
        choose_devices("mps")
    with pytest.raises(InputError) as raised:
        choose_devices("cuda", renderer="cpu")
    assert raised.value.argument == "device"
    assert refused.value.argument == "device"


def test_on_a_mac_networks_run_on_its_gpu_and_the_cpu_draws(monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert choose_devices("mps") == Devices("cpu", "mps")
    assert choose_devices("auto", renderer="cpu") == Devices("cpu", "mps")


def test_a_gpu_without_gsplat_runs_networks_alone(gpu, monkeypatch, caplog):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with caplog.at_level(logging.WARNING, logger="gscompleter"):
        assert choose_devices("auto") == Devices("cpu", "cuda")
        assert choose_devices("auto") == Devices("cpu", "cuda")
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1
    assert "renderer runs on the CPU" in said[0]
    assert "pip install 'gscompleter[cuda]'" in said[0]
    with pytest.raises(InputError, match="--renderer-device cpu"):
        choose_device("cuda")
    assert choose_devices("cuda", renderer="cpu") == Devices("cpu", "cuda")


def test_gsplat_without_nvcc_is_named(gpu, tmp_path, monkeypatch):
    install_gsplat(tmp_path, WITHOUT_NVCC, monkeypatch)
    monkeypatch.setattr(cpp_extension, "CUDA_HOME", None)
    assert choose_device("auto") == "cpu"
    with pytest.raises(InputError, match="lacks what compiles them: nvcc") as refused:
        choose_device("cuda")
    assert "CUDA_HOME" in str(refused.value)

    # CUDA_HOME that names a folder without nvcc is another mistake.
    forget()
    monkeypatch.setattr(cpp_extension, "CUDA_HOME", str(tmp_path))
    with pytest.raises(InputError, match="which has none"):
        choose_device("cuda")


def test_a_compiler_that_fails_is_a_sentence(gpu, tmp_path, monkeypatch):
    install_gsplat(tmp_path, BROKEN_COMPILER, monkeypatch)
    assert choose_device("auto") == "cpu"
    with pytest.raises(InputError, match="could not be compiled .gsplat_cuda.so: cannot open"):
        choose_device("cuda")


def test_a_gsplat_that_cannot_be_imported_is_a_sentence(gpu, tmp_path, monkeypatch):
    install_gsplat(tmp_path, COMPILED, monkeypatch)
    (tmp_path / "gsplat" / "__init__.py").write_text("import package_that_is_not_there\n")
    assert choose_device("auto") == "cpu"
    with pytest.raises(InputError, match="No module named 'package_that_is_not_there'"):
        choose_device("cuda")


def test_compiled_gsplat_draws_and_is_tried_once(gpu, tmp_path, monkeypatch, caplog):
    install_gsplat(tmp_path, COMPILED, monkeypatch)
    monkeypatch.setattr(gsplat_kernels, "find_missing_tools", lambda: iter(()))
    with caplog.at_level(logging.WARNING, logger="gscompleter"):
        assert choose_devices("auto") == Devices("cuda", "cuda")
        assert choose_devices("cuda", networks="cpu") == Devices("cuda", "cpu")
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1
    assert "compiled for this GPU, once" in said[0]


def test_nothing_is_said_of_compiling_what_is_compiled(gpu, tmp_path, monkeypatch, caplog):
    install_gsplat(tmp_path, COMPILED, monkeypatch)
    built = tmp_path / "extensions" / "py311_cu130" / "gsplat_cuda"
    built.mkdir(parents=True)
    (built / "gsplat_cuda.so").touch()
    with caplog.at_level(logging.WARNING, logger="gscompleter"):
        assert choose_device("auto") == "cuda"
    assert not caplog.records


def test_the_cpu_is_chosen_without_asking_for_a_gpu(monkeypatch):
    for name in ("is_available", "device_count", "_lazy_init"):
        monkeypatch.setattr(torch.cuda, name, lambda: pytest.fail("asked for a GPU"))
    # The module is run anew, as nothing may ask while it is imported either.
    module = runpy.run_path(device.__file__)
    assert module["choose_devices"]("cpu") == module["Devices"]("cpu", "cpu")
