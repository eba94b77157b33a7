"""The command `models`: list and download published weights."""

from __future__ import annotations

from dataclasses import dataclass

from gscompleter.config.settings import Settings
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class ModelsOptions(Settings):
    """List published model weights with their licences, and show which are downloaded.

    Example: gscompleter models --download da3-small
    """

    download: tuple[str, ...] = ()
    """Names of the list, whose files are downloaded first unless they are here, and compared with
    their SHA-256 if one is published."""
    json: bool = False
    """Print the result as JSON."""


def run_models(options: ModelsOptions) -> None:
    """Print the published weights and their location on this machine; download some first."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.published_weights import list_weights
    list_weights(options.download, options.json)
