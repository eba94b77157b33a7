"""The answer of a command on the standard output: lines for people, or JSON for programs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from gscompleter.apps.requests.answer import AnswerRequest


def print_answer(
    answer: AnswerRequest, content: Mapping[str, Any], lines: Iterable[object]
) -> None:
    """Print one JSON object if it is asked for, or else the lines, unless the command is quiet."""
    if answer.json:
        print_json(content)
    elif not answer.quiet:
        for line in lines:
            print(line)


def print_json(content: Mapping[str, Any]) -> None:
    """Print one JSON object; nothing else goes to the standard output of such a command."""
    print(json.dumps(content, indent=2), flush=True)
