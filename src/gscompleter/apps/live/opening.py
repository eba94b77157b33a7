"""Requests of sessions, with the steps that they go on from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gscompleter.apps.live.session import SessionStep
from gscompleter.apps.requests.completion import CompletionRequest
from gscompleter.apps.requests.scene import Size


@dataclass(frozen=True)
class SessionRequest:
    """A scene, and steps that are done again on it."""

    completion: CompletionRequest
    """How the scene is opened, and where results are written."""
    record: Mapping[str, Any]
    """Options that the session began with, as `strokes.json` keeps them."""
    resolution: Size | None = None
    """Working size as it was asked for; None for the default of `complete`."""
    steps: tuple[SessionStep, ...] = ()
    undone: tuple[SessionStep, ...] = ()
    """Steps that were undone, the next to be done again first."""
    saved: str | None = None
    """Digest of the steps that the completed scene in the output folder has."""
    notes: tuple[str, ...] = ()

    @property
    def out(self) -> Path:
        """The output folder."""
        return self.completion.results.out


@dataclass(frozen=True)
class LiveRequest:
    """A session, and the address of its page."""

    session: SessionRequest
    host: str
    port: int
    """Port of the page; 0 for a free one."""
    opens_browser: bool
