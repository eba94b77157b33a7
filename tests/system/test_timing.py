"""Wall times of stages."""

from __future__ import annotations

import time

import torch

from gscompleter.system.timing import record_seconds, timed_stage

LEFT = 0.05
"""Seconds that a GPU works on after calls have returned."""


def test_what_a_gpu_still_works_on_counts_in_total(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: time.sleep(LEFT))
    with record_seconds() as without_stage:
        pass
    with record_seconds() as with_stage, timed_stage("lift"):
        pass
    assert without_stage["total"] >= LEFT
    assert with_stage["total"] >= with_stage["lift"] >= LEFT


def test_a_stage_inside_another_counts_there():
    with record_seconds() as seconds, timed_stage("lift"), timed_stage("register"):
        time.sleep(LEFT)
    assert seconds["lift"] >= LEFT
    assert seconds["register"] == 0
