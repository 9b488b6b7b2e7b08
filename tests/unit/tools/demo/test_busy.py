"""A busy computer is named at the start of a demo and in its summary."""

import os

import numpy as np
import pytest

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.demo import busy
from monstertruckd.tools.demo.summary import Summary
from monstertruckd.tools.simulation.operator import Lap


def test_a_load_beyond_the_processors_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(os, "getloadavg", lambda: (5.5, 1.0, 1.0))
    assert busy() == "this computer is busy: load 5.5 on 2 processors"
    monkeypatch.setattr(os, "getloadavg", lambda: (1.9, 9.0, 9.0))
    assert busy() == ""


@pytest.mark.parametrize(("late", "stops", "named"), [(0.05, True, True), (0.05, False, False), (0.005, True, False)])
def test_stops_of_a_busy_computer_come_with_the_way_out(late: float, stops: bool, named: bool):
    reasons = (Reason.SCAN_STALE,) if stops else ()
    lap = Lap(Reason.GOAL_REACHED, 0, 10**9, np.zeros(3), reasons)
    summary = Summary(lap, np.zeros((3, 6)), late, late)
    rows = dict(summary.rows())
    assert ("busy computer" in rows) is named
    if named:
        assert rows["busy computer"] == "ticks were 50 ms late: end other programs, or use --fast"
