"""Safe reading of tensors from weight files: code in a file is never run."""

from __future__ import annotations

import os
import pickle
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gscompleter.models.weights.fetching import fetch
from gscompleter.models.weights.published import PUBLISHED, PublishedWeights
from gscompleter.system.damage import describe_damage
from gscompleter.system.errors import InputError, join_names, quote_value, refuse_pointer
from gscompleter.system.files.reading import hash_file, is_zip_file, open_file

IGNORED_PREFIXES = ("decoder.", "losses.")
"""Prefixes of tensors of other parts that training checkpoints contain, beside those of the network
with a prefix of its own."""


def read_state_dict(path: Path, weights: PublishedWeights) -> dict[str, Tensor]:
    """Read the network's tensors from a file, memory-mapped if possible, to the CPU.

    The file is verified by its published SHA-256, or by the archive's checksums if there is none. A
    `.safetensors` file in place of a published pickle has no hash; its tensors only have to fit.

    Raises:
        InputError: The file is missing, damaged, a different one, or contains other objects.
    """
    check_kind(path, weights.file)
    # A converted file has no published hash.
    is_converted = is_safetensors(path) and not is_safetensors(Path(weights.file))
    if weights.sha256 is not None and not is_converted:
        check_sha256(path, weights.sha256, weights.file)
    else:
        check_archive(path, weights.file)
    read = read_safetensors if is_safetensors(path) else read_tensors
    return extract_network_tensors(read(path, weights.file), path, weights)


def is_safetensors(path: Path) -> bool:
    """Return True for a file that is read as safetensors, by its ending."""
    return path.suffix.lower() == ".safetensors"


def fetch_checked(weights: PublishedWeights, local: Path | None = None) -> Path:
    """Fetch a file and check it, by its published SHA-256 unless the user names it by `local`.

    Such a file may be another network than the published one, of the same inputs and outputs; its
    graph is in it, so that no tensors have to fit ours as in `read_state_dict`.
    """
    path = fetch(weights, local)
    check_kind(path, weights.file)
    if local is None and weights.sha256 is not None:
        check_sha256(path, weights.sha256, weights.file)
    return path


def check_kind(path: Path, name: str) -> None:
    """Raise InputError if a file is missing, empty, a Git LFS pointer, a web page, or truncated."""
    if not os.path.isfile(path):
        raise InputError(f"There is no file {quote_value(path)}; put {name} there.")
    with open_file(path) as file:
        head = file.read(64)
    refuse_pointer(path)
    wrong = ""
    if not head:
        wrong = "is empty"
    elif head.lstrip().lower().startswith((b"<!doctype", b"<html")):
        wrong = "is a web page that was saved under this name"
    elif head.startswith(b"PK\x03\x04") and not is_zip_file(path):
        wrong = "ends too early, as after an interrupted download"
    if wrong:
        raise _create_file_error(path, wrong, name)


def check_sha256(path: Path, expected: str, name: str) -> None:
    """Raise InputError if the SHA-256 of a file does not start with `expected`."""
    digest = hash_file(path)
    if digest.startswith(expected):
        return
    for other in PUBLISHED.values():
        if other.sha256 is not None and digest.startswith(other.sha256):
            raise InputError(
                f"{quote_value(path)} is not the published file {name} but that of {other.name}; "
                f"choose that model, or fetch {name}."
            )
    raise _create_file_error(path, f"is not the published file (SHA-256 {digest[:8]})", name)


def check_archive(path: Path, name: str) -> None:
    """Raise InputError if a part of a zip archive does not match its checksum."""
    if not is_zip_file(path):
        return
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except Exception as error:  # damaged archives raise many types
        damaged = describe_damage(error)
    if damaged is not None:
        raise _create_file_error(path, f"is damaged ({quote_value(damaged)})", name)


def read_tensors(path: Path, name: str) -> Any:
    """Read a torch file that contains only tensors in plain containers."""
    try:
        # Old files of torch are not zip archives and cannot be mapped.
        mapped = is_zip_file(path)
        return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    except pickle.UnpicklingError as error:
        # A pickle may name any function; torch refuses it and names what it refused.
        refused = re.search(r"GLOBAL (\S+)", str(error))
        if refused is None:
            raise _create_file_error(path, "holds no plain weights", name) from error
        objects = f"Python objects too ({quote_value(refused[1])}), which may run any code"
        raise _create_file_error(path, f"holds {objects}", name) from error
    except Exception as error:  # damaged pickles raise many types
        raise _create_file_error(path, "cannot be read by torch", name) from error


def read_safetensors(path: Path, name: str) -> dict[str, Tensor]:
    """Read a `.safetensors` file."""
    try:
        import safetensors.torch
    except ImportError as error:
        raise InputError(
            f"To read {quote_value(path)}, safetensors is needed: pip install safetensors; or give "
            f"{name}."
        ) from error
    try:
        return safetensors.torch.load_file(path)
    except Exception as error:  # damaged files raise many types
        raise InputError(
            f"{quote_value(path)} is no safetensors file ({quote_value(describe_damage(error))}); "
            f"give {name}."
        ) from error


def extract_network_tensors(
    content: Any, path: Path, weights: PublishedWeights
) -> dict[str, Tensor]:
    """Extract the network's tensors, without the prefix of their names; others are refused."""
    prefix = weights.prefix

    def create_error(held: str) -> InputError:
        return InputError(f"{quote_value(path)} holds {held}; give {weights.file}.")

    def is_known(key: str, value: object) -> bool:
        if key.startswith(prefix):
            return isinstance(value, Tensor)
        return key.startswith(IGNORED_PREFIXES)

    # Some files have the tensors in an entry, beside the state of the training.
    inner = content.get(weights.entry, content) if isinstance(content, Mapping) else None
    if not isinstance(inner, Mapping) or not all(isinstance(key, str) for key in inner):
        raise create_error("no named tensors")
    if not inner:
        raise create_error("no tensors")
    tensors = {k.removeprefix(prefix): v for k, v in inner.items() if k.startswith(prefix)}
    if not tensors:
        raise create_error(f"no tensors named {prefix}…, but {_list_some(list(inner))}")
    unknown = [key for key, value in inner.items() if not is_known(key, value)]
    if unknown:
        raise create_error(f"more than the network {weights.name}: {_list_some(unknown)}")
    # Only dense tensors with numbers of their own can be loaded.
    odd = [key for key, value in tensors.items() if not is_plain(value)]
    if odd:
        kinds = "they are empty shells, nested, sparse, quantized or complex"
        raise create_error(f"tensors without plain numbers ({_list_some(odd)}): {kinds}")
    return tensors


def is_plain(tensor: Tensor) -> bool:
    """Return True for a dense, real tensor that holds its numbers (a meta tensor holds none)."""
    strided = tensor.layout == torch.strided and not tensor.is_nested
    return strided and not (tensor.is_meta or tensor.is_quantized or tensor.is_complex())


def _create_file_error(path: Path, wrong: str, name: str) -> InputError:
    # In the hub's cache the path is a link; deleting its target makes the hub download again.
    file = path.resolve()
    if file == path.absolute():
        return InputError(f"{quote_value(path)} {wrong}; delete it and fetch {name} again.")
    return InputError(f"{name} {wrong}; delete {quote_value(file)} and fetch it anew.")


def _list_some(keys: list[str]) -> str:
    return join_names(keys, 3)
