"""Names of the engines, apart from these so that options do not import what starts processes."""

from __future__ import annotations

from typing import Literal

EngineName = Literal["local", "ray", "submitit"]
