"""Location of weight files: given path, our cache, the hub's cache, or download (no torch)."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from gscompleter.models.weights.published import PublishedWeights
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.downloads import get_download_folder

MAX_RETRIES = 2
"""Number of retries of a request to the hub."""
INSTALL = "pip install 'gscompleter[models]'"


class WeightsNotAvailable(InputError):  # noqa: N818  (describes a state)
    """The published weights are not on this machine."""


def fetch(weights: PublishedWeights, local: Path | None = None, offline: bool = False) -> Path:
    """Return the path of a weight file; download it to the hub's cache if it is not local.

    Args:
        weights: The published file.
        local: The file, or a folder with it under its published name. If None, our cache
            (`get_cache_path`) and the hub's cache are searched.
        offline: Download nothing, like the environment variable HF_HUB_OFFLINE=1.

    Raises:
        InputError: `local` does not exist.
        WeightsNotAvailable: The file is not local and cannot be downloaded.
    """
    if local is not None:
        path = local / weights.file if os.path.isdir(local) else local
        if not os.path.isfile(path):
            raise InputError(
                f"There are no weights at {quote_value(path)}; name the file {weights.file} or its "
                f"folder, from {weights.source}."
            )
        return path
    check_available(weights)
    return find_cached(weights) or _download(weights, offline)


def check_available(weights: PublishedWeights) -> None:
    """Raise WeightsNotAvailable if a file is not on this machine and has no automatic download."""
    if weights.repository is None and find_cached(weights) is None:
        raise WeightsNotAvailable(
            f"The weights {weights.name} are not on this machine and have no automatic download; "
            f"{_describe_manual_download(weights)}."
        )


def get_cache_path(weights: PublishedWeights) -> Path:
    """Return the path for a manually downloaded file: `weights/MODEL/FILE` in our cache."""
    return get_download_folder() / "weights" / weights.model.lower() / weights.file


def find_cached(weights: PublishedWeights) -> Path | None:
    """Find the file in our cache or in the hub's; None if it is in neither."""
    place = get_cache_path(weights)
    if os.path.isfile(place):
        return place
    if weights.repository is None or not is_hub_installed():
        return None
    from huggingface_hub import try_to_load_from_cache

    cached = try_to_load_from_cache(weights.repository, weights.file, revision=weights.revision)
    # The hub's answer may also be a mark that the file is known not to exist.
    return Path(cached) if isinstance(cached, str) else None


def is_hub_installed() -> bool:
    """Return True if huggingface_hub is installed."""
    return find_spec("huggingface_hub") is not None


def _describe_manual_download(weights: PublishedWeights) -> str:
    address = weights.url if weights.repository else f"{weights.file} from {weights.url}"
    return f"fetch {address} into {get_cache_path(weights).parent}"


@contextmanager
def limit_retries() -> Iterator[None]:
    """Limit the hub's library to `MAX_RETRIES` retries, by temporarily changed defaults."""
    from huggingface_hub import utils

    # The library has no setting for it: the defaults of its functions are changed and set back.
    # Which of the functions there are depends on its version.
    functions = (getattr(utils, name, None) for name in ("http_backoff", "http_stream_backoff"))
    all_defaults = [getattr(function, "__kwdefaults__", None) or {} for function in functions]
    changed = [
        (defaults, defaults["max_retries"])
        for defaults in all_defaults
        if "max_retries" in defaults
    ]
    verbosity = utils.logging.get_verbosity()
    utils.logging.set_verbosity_error()
    for defaults, _ in changed:
        defaults["max_retries"] = MAX_RETRIES
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="huggingface_hub")
            yield
    finally:
        utils.logging.set_verbosity(verbosity)
        for defaults, retries in changed:
            defaults["max_retries"] = retries


def _download(weights: PublishedWeights, offline: bool) -> Path:
    assert weights.repository is not None
    try:
        from huggingface_hub import constants, hf_hub_download
        from huggingface_hub.errors import LocalEntryNotFoundError
    except ImportError as error:
        raise WeightsNotAvailable(
            f"huggingface_hub is missing: {INSTALL}; or {_describe_manual_download(weights)}."
        ) from error

    # HF_HUB_OFFLINE, as all programs of the hub obey it.
    offline = offline or constants.HF_HUB_OFFLINE
    try:
        with limit_retries():
            path = hf_hub_download(
                weights.repository,
                weights.file,
                revision=weights.revision,
                local_files_only=offline,
            )
    except LocalEntryNotFoundError as error:
        reason = "downloads are off" if offline else "the hub cannot be reached"
        raise WeightsNotAvailable(
            f"The weights {weights.name} are missing and {reason}; "
            f"{_describe_manual_download(weights)}."
        ) from error
    except Exception as error:
        # The error type depends on the version of huggingface_hub; the advice does not.
        raise WeightsNotAvailable(
            f"The weights {weights.name} were not downloaded ({type(error).__name__}); "
            f"{_describe_manual_download(weights)}."
        ) from error
    return Path(path)
