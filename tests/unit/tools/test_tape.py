"""Tape, string and meter beside an emulated robot."""

import math
from types import SimpleNamespace

import pytest

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.simulation.tape import EmulatedTape


def test_it_measures_from_the_mark_what_wizards_ask_for():
    poses = iter([(1.0, 2.0, 0.5), (1.0, 2.0, 0.5), (1.0, 2.0, 0.5), (0.0, 0.0, math.pi / 2), (1.0, 2.0, -math.pi / 2)])

    def truth(now):
        x, y, yaw = next(poses)
        return SimpleNamespace(x=x, y=y, yaw=yaw, supply_v=24.831)

    said = []
    tape = EmulatedTape(SimpleNamespace(truth=truth), SimpleNamespace(now=lambda: 0), (0.5, 0.3), said.append)
    tape.command([])
    assert said.pop().startswith("pack 24.83 V; type `tape mark` first"), "the meter needs no mark"
    tape.command(["mark"])
    tape.command([])
    assert said[0].startswith(
        "front bumper 0.000 m from its mark: 0.0 cm ahead, 0.0 cm left; middle of the left side 0.0"
    )
    tape.command(["mark"])
    tape.command([])  # 2 m ahead, 1 m to the right, turned round
    assert "front bumper 1.803 m from its mark: 150.0 cm ahead, -100.0 cm left" in said[1]
    assert "middle of the left side -130.0 cm left of the string; turned" in said[1]
    assert said[1].endswith("pack 24.83 V")


def test_another_word_is_refused_with_those_it_knows():
    tape = EmulatedTape(SimpleNamespace(truth=lambda now: None), SimpleNamespace(now=lambda: 0), (0.5, 0.3), print)
    with pytest.raises(InputError, match="tape mark"):
        tape.command(["lay"])
