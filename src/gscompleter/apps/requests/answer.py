"""How a command answers on the terminal."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AnswerRequest:
    """What is printed: lines for people, or JSON for programs."""

    quiet: bool = False
    """True to print errors only, and the JSON if it is asked for."""
    json: bool = False
    """True to print the result as JSON, and no lines."""
