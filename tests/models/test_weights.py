"""Published weights: small files in the published formats, and a hub on this machine."""

from __future__ import annotations

import hashlib
import json
import os
import re
import socket
import struct
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

pytest.importorskip("huggingface_hub", reason="needs gscompleter[models]")

import huggingface_hub
from huggingface_hub import constants

from gscompleter.apps.commands.models import ModelsOptions
from gscompleter.apps.published_weights import list_weights
from gscompleter.cli import main
from gscompleter.models.weights import (
    PUBLISHED,
    PublishedWeights,
    WeightsNotAvailable,
    fetch,
    find_cached,
    get_cache_path,
    load_strictly,
    read_state_dict,
    reading,
)
from gscompleter.reconstructors import load_reconstructor
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from gscompleter.system.errors import InputError
from paths import ROOT

DOCS = ROOT / "docs"
COMMIT = "0123456789abcdef0123456789abcdef01234567"

DEPTHSPLAT = PUBLISHED["depthsplat-small-re10k"]
MVSPLAT = PUBLISHED["mvsplat-re10k"]


def network(width: int = 4) -> nn.Module:
    return nn.Sequential(nn.Linear(3, width), nn.BatchNorm1d(width))


def published_tensors(width: int = 4) -> dict[str, Tensor]:
    """Create a network's tensors with the names of the authors' training."""
    return {f"encoder.{name}": t for name, t in network(width).state_dict().items()}


def save(path: Path, content: object, like: PublishedWeights) -> PublishedWeights:
    """Save a torch file, and return its description with the new hash."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(content, path)
    digits = 64 if like.sha256 is None else len(like.sha256)
    return replace(like, sha256=hashlib.sha256(path.read_bytes()).hexdigest()[:digits])


def flip_byte(path: Path) -> None:
    """Alter one byte in the middle of the largest tensor."""
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda part: part.file_size)
    content = bytearray(path.read_bytes())
    content[largest.header_offset + 200 + largest.file_size // 2] ^= 1
    path.write_bytes(content)


def sentence_of(caught: pytest.ExceptionInfo[InputError]) -> str:
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a machine with empty caches."""
    monkeypatch.setenv("GSCOMPLETER_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "home"


# What is published.


def test_names_are_model_size_and_data_and_files_carry_them():
    for name, weights in PUBLISHED.items():
        assert name == weights.name
        if name.startswith("da3-"):  # images of any shape; files are distinguished by their folders
            assert weights.repository == f"depth-anything/{weights.model}"
            continue
        if weights.gives in ("image", "monocular depth"):  # one file each, for images of any size
            assert name.replace("-", "") == weights.model.lower().replace("-", "")
            continue
        height, width = weights.image_size
        size = "" if (height, width) == (256, 256) else f"-{height}x{width}"
        assert name.endswith(size)
        assert name.startswith(weights.model.lower() + "-")
        if weights.repository == "haofeixu/depthsplat":
            assert re.search(rf"-{height}x{width}-.*-{weights.sha256}\.pth$", weights.file)
            assert weights.file.startswith(
                "depthsplat-depth" if weights.gives == "depth" else "depthsplat-gs"
            )
            fewest, most = weights.views
            views = f"view{fewest}" if fewest == most else f"view{fewest}-{most}"
            assert views in weights.file
    assert len({(w.repository, w.file) for w in PUBLISHED.values()}) == len(PUBLISHED)


def test_files_that_are_fetched_by_hand_do_not_meet_in_one_place():
    places = [get_cache_path(w) for w in PUBLISHED.values() if not w.name.endswith("-6view")]
    assert len(set(places)) == len(places)


@pytest.mark.parametrize(
    ("network_name", "fixture"),
    [
        ("mvsplat", "mvsplat/keys"),
        ("volsplat", "volsplat/keys-re10k-vitb"),
        *(
            (f"depthsplat-{name}", f"depthsplat/keys-{name}")
            for name in ("small-s1-u4-l4", "small-s1-u8-l8", "base-s2-u2-l4")
        ),
        *((f"depthsplat-{n}", f"depthsplat/keys-{n}") for n in ("base-s2-u4-l8", "large-s2-u2-l4")),
    ],
)
def test_parameters_are_those_of_the_authors_networks(
    shared: Path, network_name: str, fixture: str
):
    millions = json.loads((shared / "fixtures" / f"{fixture}.json").read_text())["params_M"]
    found = [w.parameters for w in PUBLISHED.values() if w.network == network_name]
    assert found
    assert all(count == pytest.approx(millions * 1e6, abs=1) for count in found)


def test_what_lies_on_the_hub_has_an_address_and_what_does_not_has_a_page():
    assert DEPTHSPLAT.url == (
        "https://huggingface.co/haofeixu/depthsplat/resolve/main/"
        "depthsplat-gs-small-re10k-256x256-view2-cfeab6b1.pth"
    )
    assert MVSPLAT.url == MVSPLAT.source
    assert [w.integrity_check for w in (DEPTHSPLAT, MVSPLAT)] == [
        "first 8 digits of SHA-256",
        "nothing",
    ]
    assert replace(MVSPLAT, sha256="0" * 64).integrity_check == "SHA-256"


def test_every_file_without_a_plain_licence_says_why():
    for weights in PUBLISHED.values():
        started_from_nc = "-base-" in weights.name or "-large-" in weights.name
        # The licence of VolSplat's card is plain; what it started from is not.
        started_from_nc |= weights.model == "VolSplat" or weights.name == "depthsplat-re10k-6view"
        on_dl3dv = "dl3dv" in weights.name or weights.gives == "depth"
        unlicensed = weights.weights_licence in ("not stated", "CC BY-NC 4.0")
        assert bool(weights.caution) == (started_from_nc or on_dl3dv or unlicensed), weights.name


def test_the_page_of_models_has_a_row_for_every_file():
    rows = [line for line in (DOCS / "models.md").read_text().splitlines() if line[:1] == "|"]
    for weights in PUBLISHED.values():
        (row,) = [row for row in rows if row.startswith(f"| `{weights.name}` |")]
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        fewest, most = weights.views
        near_far = weights.near_far and "{:g} / {:g}".format(*weights.near_far)
        count = weights.parameters
        assert cells == [
            f"`{weights.name}`",
            "not stated" if count is None else f"{count / 1e6:.1f} M",
            f"{fewest}" if fewest == most else f"{fewest} to {most}",
            "{}x{}".format(*weights.image_size),
            near_far or "not stated",
            f"{weights.code_licence} / {weights.weights_licence}",
            weights.caution or "allowed",
            f"[{weights.file}]({weights.url})",
            weights.integrity_check,
        ]


# Where a file comes from.


def test_a_local_file_or_the_folder_that_holds_it_is_taken_as_it_is(tmp_path: Path):
    file = tmp_path / DEPTHSPLAT.file
    file.write_bytes(b"anything")
    assert fetch(DEPTHSPLAT, file) == file
    assert fetch(DEPTHSPLAT, tmp_path) == file
    with pytest.raises(InputError, match="no weights at") as caught:
        fetch(DEPTHSPLAT, tmp_path / "nowhere.pth")
    assert DEPTHSPLAT.file in sentence_of(caught)


@pytest.mark.parametrize("weights", [MVSPLAT, DEPTHSPLAT], ids=lambda w: w.name)
def test_a_file_put_into_the_cache_by_hand_is_used(weights: PublishedWeights, home: Path):
    place = get_cache_path(weights)
    assert place == home / "weights" / weights.model.lower() / weights.file
    place.parent.mkdir(parents=True)
    place.write_bytes(b"anything")
    assert fetch(weights, offline=True) == place


def test_the_cache_is_in_the_home_folder_unless_the_environment_says_otherwise(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.delenv("GSCOMPLETER_HOME")
    folder = Path.home() / ".cache" / "gscompleter" / "weights"
    assert get_cache_path(MVSPLAT) == folder / "mvsplat" / "re10k.ckpt"


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [("typo", "There are no weights 'typo'"), (MVSPLAT.name, "have no automatic download")],
)
def test_no_file_is_downloaded_before_all_names_are_checked(home, monkeypatch, wrong, sentence):
    fetched: list[PublishedWeights] = []
    monkeypatch.setattr(reading, "fetch_checked", fetched.append)
    with pytest.raises(InputError, match=sentence):
        list_weights(["da3-small", wrong], as_json=True)
    assert fetched == []


def test_the_example_of_a_download_can_be_downloaded():
    (words,) = re.findall(r"models --download (.+)", ModelsOptions.__doc__ or "")
    assert all(PUBLISHED[name].repository for name in words.split())


def test_what_lies_on_google_drive_has_to_be_fetched_by_hand():
    with pytest.raises(WeightsNotAvailable, match="no automatic download") as caught:
        fetch(MVSPLAT)
    sentence = sentence_of(caught)
    for part in (
        "mvsplat-re10k",
        "re10k.ckpt",
        MVSPLAT.source,
        str(get_cache_path(MVSPLAT).parent),
    ):
        assert part in sentence


def test_without_the_hubs_package_the_sentence_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(WeightsNotAvailable, match=r"pip install 'gscompleter\[models\]'") as caught:
        fetch(DEPTHSPLAT)
    sentence = sentence_of(caught)
    assert DEPTHSPLAT.url in sentence
    assert str(get_cache_path(DEPTHSPLAT).parent) in sentence


def hub_cache(
    folder: Path, weights: PublishedWeights, content: bytes, original: bytes | None = None
) -> Path:
    """Create a hub cache like its library: a file by its hash, and a link by its name.

    If the content was damaged later, the hash is that of the original.
    """
    assert weights.repository is not None
    repository = folder / f"models--{weights.repository.replace('/', '--')}"
    blob = repository / "blobs" / hashlib.sha256(original or content).hexdigest()
    link = repository / "snapshots" / COMMIT / weights.file
    reference = repository / "refs" / "main"
    for path in (blob, link, reference):
        path.parent.mkdir(parents=True)
    blob.write_bytes(content)
    reference.write_text(COMMIT)
    link.symlink_to(os.path.relpath(blob, link.parent))
    return link


def test_what_is_in_the_hubs_cache_is_found_without_a_connection(tmp_path: Path):
    assert find_cached(DEPTHSPLAT) is None
    link = hub_cache(tmp_path / "hub", DEPTHSPLAT, b"weights")
    assert fetch(DEPTHSPLAT, offline=True) == find_cached(DEPTHSPLAT) == link
    assert link.read_bytes() == b"weights"


def test_another_commit_in_the_hubs_cache_is_not_taken_for_the_pinned_one(tmp_path: Path):
    hub_cache(tmp_path / "hub", DEPTHSPLAT, b"weights")
    assert find_cached(replace(DEPTHSPLAT, revision=COMMIT)) is not None
    assert find_cached(replace(DEPTHSPLAT, revision=COMMIT[::-1])) is None


@pytest.mark.parametrize("by_environment", [False, True])
def test_offline_and_absent_says_how_to_bring_the_file(
    by_environment: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", by_environment)
    with pytest.raises(WeightsNotAvailable, match="downloads are off") as caught:
        fetch(DEPTHSPLAT, offline=not by_environment)
    assert DEPTHSPLAT.url in sentence_of(caught)


def test_the_hub_is_asked_for_the_pinned_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    requests = []

    def download(repository: str, file: str, **others: object) -> str:
        requests.append((repository, file, others))
        return str(tmp_path / file)

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    pinned = replace(DEPTHSPLAT, revision=COMMIT)
    assert fetch(pinned) == tmp_path / pinned.file
    expected = {"revision": COMMIT, "local_files_only": False}
    assert requests == [("haofeixu/depthsplat", pinned.file, expected)]


class Hub(BaseHTTPRequestHandler):
    """A minimal hub: one file of one commit, and 404 for the rest."""

    def __init__(self, weights: PublishedWeights, content: bytes, *rest: object) -> None:
        self.path_of_file = f"/{weights.repository}/resolve/{weights.revision}/{weights.file}"
        self.content = content
        super().__init__(*rest)  # type: ignore[arg-type]

    def do_HEAD(self) -> None:
        there = self.path == self.path_of_file
        self.send_response(200 if there else 404)
        if there:
            self.send_header("ETag", f'"{hashlib.sha256(self.content).hexdigest()}"')
            self.send_header("X-Repo-Commit", COMMIT)
            self.send_header("Content-Length", str(len(self.content)))
        else:
            self.send_header("X-Error-Code", "EntryNotFound")
            self.send_header("Content-Length", "0")
        self.end_headers()

    def do_GET(self) -> None:
        self.do_HEAD()
        if self.path == self.path_of_file:
            self.wfile.write(self.content)

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[PublishedWeights, bytes], None]]:
    """Start a local hub and direct all requests to it."""
    servers = []

    def start(weights: PublishedWeights, content: bytes) -> None:
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Hub, weights, content))
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        template = address + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "ENDPOINT", address)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def test_a_download_lands_in_the_hubs_cache_and_is_read(tmp_path: Path, serve: Callable):
    weights = save(tmp_path / "original.pth", published_tensors(), DEPTHSPLAT)
    serve(weights, (tmp_path / "original.pth").read_bytes())
    path = fetch(weights)
    assert path.is_relative_to(tmp_path / "hub")
    assert find_cached(weights) == path
    load_strictly(network(), read_state_dict(path, weights), path)


def test_a_damaged_download_is_fetched_anew_once_it_is_deleted_as_told(
    tmp_path: Path, tmp_path_factory, monkeypatch: pytest.MonkeyPatch, serve: Callable
):
    hub = tmp_path_factory.mktemp("h")  # a short name, so that the sentence is not cut
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(hub))
    weights = save(tmp_path / "original.pth", published_tensors(), DEPTHSPLAT)
    original = (tmp_path / "original.pth").read_bytes()
    hub_cache(hub, weights, b"damaged", original)
    with pytest.raises(InputError, match="delete") as caught:
        read_state_dict(fetch(weights), weights)
    found = re.search(r"delete (\S+) and", sentence_of(caught))
    assert found is not None
    Path(found[1]).unlink()
    serve(weights, original)
    assert read_state_dict(fetch(weights), weights).keys() == network().state_dict().keys()


def test_a_hub_out_of_reach_is_tried_three_times_and_told_in_one_line(monkeypatch, capfd):
    from huggingface_hub.utils import http_backoff

    with socket.socket() as bound:  # nobody listens there
        bound.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{bound.getsockname()[1]}"
    waited: list[float] = []
    monkeypatch.setattr("time.sleep", waited.append)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setattr(constants, "ENDPOINT", address)
    template = address + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with pytest.raises(WeightsNotAvailable, match="the hub cannot be reached") as caught:
        fetch(DEPTHSPLAT)
    assert len(waited) <= 2
    assert DEPTHSPLAT.url in sentence_of(caught)
    assert capfd.readouterr().err == ""
    assert http_backoff.__kwdefaults__["max_retries"] != 2


def test_a_file_that_the_hub_does_not_have_is_one_sentence(serve: Callable):
    serve(replace(DEPTHSPLAT, file="another.pth"), b"")
    with pytest.raises(WeightsNotAvailable, match="EntryNotFound") as caught:
        fetch(DEPTHSPLAT)
    assert DEPTHSPLAT.source in sentence_of(caught)


# What a file holds.


@pytest.mark.parametrize(
    "content",
    [
        {"epoch": 3, "state_dict": published_tensors(), "optimizer_states": []},
        published_tensors(),
        {"state_dict": published_tensors() | {"decoder.background": torch.zeros(3)}},
    ],
    ids=["lightning", "bare", "decoder"],
)
def test_the_networks_tensors_come_out_under_its_own_names(tmp_path: Path, content: object):
    path = tmp_path / "weights.pth"
    weights = save(path, content, DEPTHSPLAT)
    tensors = read_state_dict(path, weights)
    model = network()
    load_strictly(model, tensors, path)
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, tensors[name])


def test_depth_networks_lie_under_another_entry_without_a_prefix(tmp_path: Path):
    path = tmp_path / "depth.pth"
    weights = save(
        path, {"model": network().state_dict()}, PUBLISHED["depthsplat-depth-base-352x640"]
    )
    load_strictly(network(), read_state_dict(path, weights), path)


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [({"decoder.step": 3}, "more than the network .*: decoder.step"), ({}, "holds no tensors;")],
)
def test_every_entry_of_a_network_without_a_prefix_has_to_be_a_tensor(
    tmp_path: Path, entries: dict[str, object], sentence: str
):
    path = tmp_path / "depth.pth"
    torch.save({"model": entries}, path)
    weights = replace(PUBLISHED["depthsplat-depth-base-352x640"], sha256=None)
    refused(path, weights, sentence)


def test_older_files_of_torch_are_read_too(tmp_path: Path):
    path = tmp_path / "old.ckpt"
    torch.save(published_tensors(), path, _use_new_zipfile_serialization=False)
    assert read_state_dict(path, MVSPLAT).keys() == network().state_dict().keys()


def refused(path: Path, weights: PublishedWeights, sentence: str) -> None:
    """Check that reading fails with one sentence that names the expected file."""
    with pytest.raises(InputError, match=sentence) as caught:
        read_state_dict(path, weights)
    assert weights.file in sentence_of(caught)
    assert str(path) in str(caught.value)


def test_an_altered_byte_is_found_by_the_published_digits(tmp_path: Path):
    path = tmp_path / "weights.pth"
    weights = save(path, published_tensors(), DEPTHSPLAT)
    assert len(weights.sha256 or "") == 8
    read_state_dict(path, weights)
    flip_byte(path)
    refused(path, weights, "not the published file")


def test_an_altered_byte_is_found_without_a_published_hash(tmp_path: Path):
    path = tmp_path / "weights.ckpt"
    save(path, published_tensors(width=200), MVSPLAT)
    read_state_dict(path, MVSPLAT)
    flip_byte(path)
    refused(path, MVSPLAT, "is damaged")


def test_the_digits_are_compared_as_a_prefix(tmp_path: Path):
    path = tmp_path / "weights.pth"
    weights = save(path, published_tensors(), DEPTHSPLAT)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    for digits in (1, 8, 64):
        read_state_dict(path, replace(weights, sha256=digest[:digits]))
    refused(path, replace(weights, sha256=digest[1:9]), "not the published file")


def test_another_published_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "weights.pth"
    large = save(path, published_tensors(), PUBLISHED["depthsplat-large-re10k"])
    monkeypatch.setitem(PUBLISHED, large.name, large)
    refused(path, DEPTHSPLAT, "but that of depthsplat-large-re10k")


@pytest.mark.parametrize("weights", [DEPTHSPLAT, MVSPLAT], ids=lambda w: w.name)
@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is empty"),
        (b"\n<!DOCTYPE html><html>Too many users have viewed this file", "web page"),
    ],
)
def test_what_is_no_file_of_weights_is_told_from_its_head(
    tmp_path: Path, weights: PublishedWeights, content: bytes, sentence: str
):
    path = tmp_path / "weights.pth"
    path.write_bytes(content)
    refused(path, weights, sentence)


def test_a_missing_file_is_named(tmp_path: Path):
    refused(tmp_path / "nowhere.pth", MVSPLAT, "no file")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
@pytest.mark.parametrize("zipped", [True, False])
def test_a_truncated_file_is_refused(tmp_path: Path, share: float, zipped: bool):
    path = tmp_path / "weights.ckpt"
    torch.save(published_tensors(), path, _use_new_zipfile_serialization=zipped)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(path, MVSPLAT, "ends too early" if zipped else "plain weights|cannot be read")


class Trap:
    """An object that a plain unpickling would run."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (os.mkdir, (TRAP_FOLDER,))


TRAP_FOLDER = ""


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_file_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zipped: bool):
    monkeypatch.setattr(sys.modules[__name__], "TRAP_FOLDER", str(tmp_path / "trapped"))
    path = tmp_path / "weights.ckpt"
    content = {"state_dict": published_tensors(), "callbacks": Trap()}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    refused(path, MVSPLAT, r"Python objects too \(\S*mkdir\)")
    assert not (tmp_path / "trapped").exists()
    torch.load(path, weights_only=False)
    assert (tmp_path / "trapped").exists(), "the file was no trap"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"state_dict": published_tensors() | {"head.weight": torch.zeros(1)}}, "head.weight"),
        ({"state_dict": published_tensors() | {"encoder.step": 3}}, "encoder.step"),
        ({"model": {"a": torch.zeros(1)}}, "no tensors named encoder.…, but model"),
        ({"state_dict": {"decoder.a": torch.zeros(1)}}, "no tensors named encoder.…"),
        ({"state_dict": [torch.zeros(1)]}, "no named tensors"),
        ([torch.zeros(1)], "no named tensors"),
        ({1: torch.zeros(1)}, "no named tensors"),
        (torch.zeros(1), "no named tensors"),
    ],
)
def test_what_is_not_the_networks_is_refused(tmp_path: Path, content: object, sentence: str):
    path = tmp_path / "weights.ckpt"
    torch.save(content, path)
    refused(path, MVSPLAT, sentence)


def write_safetensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write the format manually: length of the JSON header, header, and data bytes."""
    names = {torch.float32: "F32", torch.int64: "I64"}
    header, data = {}, b""
    for name, tensor in tensors.items():
        content = tensor.numpy().tobytes()
        header[name] = {
            "dtype": names[tensor.dtype],
            "shape": list(tensor.shape),
            "data_offsets": [len(data), len(data) + len(content)],
        }
        data += content
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


@pytest.mark.parametrize("name", ["weights.safetensors", "WEIGHTS.SAFETENSORS"])
def test_a_conversion_to_safetensors_needs_no_hash_but_has_to_fit(tmp_path: Path, name: str):
    pytest.importorskip("safetensors", reason="needs gscompleter[models]")
    path = tmp_path / name
    tensors = published_tensors()
    write_safetensors(path, tensors)
    found = read_state_dict(path, DEPTHSPLAT)
    assert all(torch.equal(tensors[f"encoder.{name}"], t) for name, t in found.items())
    path.write_bytes(path.read_bytes()[:-1])
    refused(path, DEPTHSPLAT, "no safetensors file")


def test_without_the_package_safetensors_the_sentence_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    path = tmp_path / "weights.safetensors"
    write_safetensors(path, published_tensors())
    refused(path, DEPTHSPLAT, "pip install safetensors")


def test_only_safetensors_escape_the_hash(tmp_path: Path):
    path = tmp_path / "renamed.bin"
    save(path, published_tensors(), DEPTHSPLAT)
    refused(path, DEPTHSPLAT, "not the published file")


# Tensors into a network.


def test_tensors_that_fit_replace_those_of_the_network():
    source, model = network(), network()
    load_strictly(model, source.state_dict(), "here")
    assert torch.equal(model[0].weight, source[0].weight)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda d: d.pop("0.bias"), r"lacks 1 of 7 tensors \(such as 0.bias\)"),
        (lambda d: d.update(more=torch.zeros(1)), r"1 unknown to the network \(such as m"),
        (
            lambda d: d.update({"0.weight": torch.zeros(4, 5)}),
            r"1 of another shape \(such as 0.weight, \[4, 5\] instead of \[4, 3\]\)",
        ),
    ],
)
def test_tensors_that_do_not_fit_leave_the_network_as_it_was(
    change: Callable[[dict[str, Tensor]], object], sentence: str
):
    model = network()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    tensors = dict(network().state_dict())
    change(tensors)
    with pytest.raises(InputError, match=sentence) as caught:
        load_strictly(model, tensors, "w.pth")
    assert sentence_of(caught).startswith("w.pth does not fit the network Sequential: ")
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


def test_the_variant_that_the_tensors_belong_to_is_named():
    variants = {
        name: {key: tuple(t.shape) for key, t in network(width).state_dict().items()}
        for name, width in (("small", 4), ("base", 6), ("large", 8))
    }
    with pytest.raises(InputError, match="its tensors are those of base") as caught:
        load_strictly(network(4), network(6).state_dict(), "w.pth", lambda: variants)
    sentence_of(caught)
    with pytest.raises(InputError, match="give another file"):
        load_strictly(network(4), network(7).state_dict(), "w.pth", lambda: variants)


def test_variants_are_only_built_where_they_are_needed():
    load_strictly(network(), network().state_dict(), "w.pth", lambda: pytest.fail("built"))


# Reconstructors and the command.


def test_the_embedded_reconstructor_takes_no_weights():
    assert isinstance(load_reconstructor("plane-sweep"), PlaneSweep)
    with pytest.raises(InputError, match="takes no weights"):
        load_reconstructor("plane-sweep", Path("w.pth"))


def models(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    monkeypatch.setattr(sys, "argv", ["gscompleter", "models", *more])
    main()
    return capsys.readouterr().out


def test_models_are_listed_with_licence_and_place(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    place = get_cache_path(MVSPLAT)
    place.parent.mkdir(parents=True)
    place.write_bytes(b"anything")
    lines = models(monkeypatch, capsys).splitlines()
    rows = {line.split()[0]: line for line in lines if "https://" in line}
    assert rows.keys() == PUBLISHED.keys()
    assert str(place) in rows["mvsplat-re10k"]
    assert "MIT / not stated (!)" in rows["mvsplat-re10k"]
    small = re.split(r" {2,}", rows["depthsplat-small-re10kdl3dv-448x768"].strip())
    assert small[1:7] == ["DepthSplat", "38.4 M", "4-10", ">= 153 MB", "MIT / MIT (!)", "no"]
    cautions = {w.caution for w in PUBLISHED.values() if w.caution}
    assert all(any(line.endswith(f": {c}.") for line in lines) for c in cautions)


def test_models_without_the_hubs_package_say_that_its_cache_was_not_seen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert "for lack of huggingface_hub" not in models(monkeypatch, capsys)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert "for lack of huggingface_hub" in models(monkeypatch, capsys)


def test_models_as_json_say_everything(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    link = hub_cache(tmp_path / "hub", DEPTHSPLAT, b"weights")
    rows = {row["name"]: row for row in json.loads(models(monkeypatch, capsys, "--json"))}
    assert rows.keys() == PUBLISHED.keys()
    small = rows["depthsplat-small-re10k"]
    assert (small["cached"], small["sha256"], small["views"]) == (str(link), "cfeab6b1", [2, 2])
    assert rows["mvsplat-acid"]["cached"] is None
    assert rows["mvsplat-acid"]["place"] == str(get_cache_path(PUBLISHED["mvsplat-acid"]))


def test_models_do_not_wait_for_torch():
    code = (
        "import sys; sys.argv = ['gscompleter', 'models', '--json']\n"
        "from gscompleter.cli import main\n"
        "main()\n"
        "heavy = {'torch', 'numba', 'cv2', 'skimage', 'numpy'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)) == len(PUBLISHED)
