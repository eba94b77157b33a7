"""Where a file of weights comes from: a path, our cache, the hub's cache, or a download.

Nothing here imports torch.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from gscompleter.cache import cache_folder
from gscompleter.errors import InputError
from gscompleter.weights.published import PublishedWeights

MAX_RETRIES = 2
"""Retries of a request to the hub."""
INSTALL = "pip install 'gscompleter[models]'"


class WeightsNotAvailable(InputError):  # noqa: N818  (a state of affairs, told in a sentence)
    """The published weights are not on this machine."""


def fetch(weights: PublishedWeights, local: Path | None = None, offline: bool = False) -> Path:
    """The path of a file of weights, downloaded where it is not on this machine yet.

    What the file holds is checked when it is read. A download shows the hub's progress bar and
    lands in the hub's cache.

    Args:
        weights: Which file.
        local: The file, or a folder that holds it under its published name. None looks into our
            cache (`place_of`), then into that of the hub.
        offline: Download nothing. The environment variable HF_HUB_OFFLINE=1 says the same.

    Raises:
        InputError: where `local` does not exist.
        WeightsNotAvailable: where the file is not here and cannot be downloaded.
    """
    if local is not None:
        return _given(weights, local)
    found = cached(weights)
    if found is not None:
        return found
    if weights.repository is None:
        raise WeightsNotAvailable(
            f"The weights {weights.name} are not here and no program can fetch them: "
            f"{_by_hand(weights)}."
        )
    return _download(weights, offline)


def place_of(weights: PublishedWeights) -> Path:
    """Where a file that was fetched by hand is looked for: `weights/MODEL/FILE` in our cache."""
    return cache_folder() / "weights" / weights.model.lower() / weights.file


def cached(weights: PublishedWeights) -> Path | None:
    """The file in our cache or in that of the hub, or None; nothing is downloaded."""
    place = place_of(weights)
    if os.path.isfile(place):
        return place
    if weights.repository is None or not hub_is_installed():
        return None
    from huggingface_hub import try_to_load_from_cache

    found = try_to_load_from_cache(weights.repository, weights.file, revision=weights.revision)
    return Path(found) if isinstance(found, str) else None


def hub_is_installed() -> bool:
    """Whether the package huggingface_hub is there, without which no hub cache is seen."""
    return find_spec("huggingface_hub") is not None


def _given(weights: PublishedWeights, local: Path) -> Path:
    path = local / weights.file if os.path.isdir(local) else local
    if not os.path.isfile(path):
        raise InputError(
            f"There are no weights at {path}; name the file {weights.file} or a folder that holds "
            f"it, which {weights.source} gives out."
        )
    return path


def _by_hand(weights: PublishedWeights) -> str:
    address = weights.url if weights.repository else f"{weights.file} from {weights.url}"
    return f"fetch {address} into {place_of(weights).parent}"


@contextmanager
def few_retries() -> Iterator[None]:
    """Let the hub's library try `MAX_RETRIES` times again, and say nothing of it.

    It has no setting for the number, so the defaults of its functions are others meanwhile.
    """
    from huggingface_hub import utils

    functions = (getattr(utils, name, None) for name in ("http_backoff", "http_stream_backoff"))
    defaults = [getattr(function, "__kwdefaults__", None) or {} for function in functions]
    changed = [(held, held["max_retries"]) for held in defaults if "max_retries" in held]
    verbosity = utils.logging.get_verbosity()
    utils.logging.set_verbosity_error()
    for held, _ in changed:
        held["max_retries"] = MAX_RETRIES
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="huggingface_hub")
            yield
    finally:
        utils.logging.set_verbosity(verbosity)
        for held, retries in changed:
            held["max_retries"] = retries


def _download(weights: PublishedWeights, offline: bool) -> Path:
    assert weights.repository is not None
    try:
        from huggingface_hub import constants, hf_hub_download
        from huggingface_hub.errors import LocalEntryNotFoundError
    except ImportError as error:
        raise WeightsNotAvailable(
            f"huggingface_hub is missing: {INSTALL}; or {_by_hand(weights)}."
        ) from error
    offline = offline or constants.HF_HUB_OFFLINE
    try:
        with few_retries():
            path = hf_hub_download(
                weights.repository,
                weights.file,
                revision=weights.revision,
                local_files_only=offline,
            )
    except LocalEntryNotFoundError as error:
        reason = "downloads are off" if offline else "the hub cannot be reached"
        raise WeightsNotAvailable(
            f"The weights {weights.name} are not here and {reason}; {_by_hand(weights)}."
        ) from error
    except Exception as error:
        # Which library's errors come through depends on the version of huggingface_hub; whatever
        # it was, the way out is the same.
        raise WeightsNotAvailable(
            f"The weights {weights.name} were not downloaded ({type(error).__name__}); "
            f"{_by_hand(weights)}."
        ) from error
    return Path(path)
