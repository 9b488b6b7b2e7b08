"""The operator at a terminal: answers given beforehand, typed ones, and none."""

import asyncio
import os
import pty
import sys
from collections.abc import Iterator

import pytest

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.calibrate.steps import Confirm, Number
from monstertruckd.tools.cli.calibrate_panel import TerminalPanel

DISTANCE = Number("distance", "how far, m?", 0.2, 20.0)
READY = Confirm("ready", "ready?")
FORWARD = Confirm("forward", "forward?", fact=True)


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Write end of what is standard input."""
    reading, writing = os.pipe()
    with os.fdopen(reading) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield writing
        os.close(writing)


async def test_answers_come_in_the_order_of_asking(capsys: pytest.CaptureFixture[str]):
    panel = TerminalPanel(["distance=1.98", "forward=no", "distance=2,02"])
    assert [await panel.number(DISTANCE), await panel.number(DISTANCE)] == [1.98, 2.02]
    assert not await panel.confirm(FORWARD)
    shown = capsys.readouterr()
    assert shown.out == "", "the result alone goes there"
    assert shown.err.splitlines() == ["how far, m? 1.98", "how far, m? 2,02", "forward? [y/n] no"]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ("distance=far", "distance: 'far' is not a number"),
        ("distance=0.1", "distance: 0.1 is not within 0.2 to 20"),
        ("distance=nan", "distance: nan is not within"),
    ],
)
async def test_a_wrong_answer_given_beforehand_ends_it(answer: str, said: str):
    with pytest.raises(InputError, match=said):
        await TerminalPanel([answer]).number(DISTANCE)


async def test_yes_says_what_is_done_but_not_what_is_seen(keyboard: int):
    panel = TerminalPanel([], yes=True)
    assert await panel.confirm(READY)
    os.write(keyboard, b"maybe\ny\n")
    assert await panel.confirm(FORWARD)
    with pytest.raises(InputError, match="'perhaps': expected yes or no"):
        await TerminalPanel(["forward=perhaps"]).confirm(FORWARD)


async def test_typed_lines(keyboard: int, capsys: pytest.CaptureFixture[str]):
    os.write(keyboard, b"two\n50\n2.")
    os.write(keyboard, b"013\n\nn\n")
    panel = TerminalPanel([])
    assert await panel.number(DISTANCE) == 2.013
    assert await panel.confirm(READY), "Enter will do"
    assert not await panel.confirm(READY)
    err = capsys.readouterr().err
    assert "'two' is not a number" in err
    assert "50 is not within" in err


async def test_what_was_typed_before_the_question_is_no_answer(monkeypatch: pytest.MonkeyPatch):
    typing, terminal = pty.openpty()
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        os.write(typing, b"\n\n")  # Enter, pressed while the truck still drove
        answer = asyncio.create_task(TerminalPanel([]).confirm(READY))
        await asyncio.sleep(0.05)
        assert not answer.done()
        os.write(typing, b"n\n")
        assert not await answer
    os.close(typing)


async def test_no_answer_names_the_option(monkeypatch: pytest.MonkeyPatch):
    with open(os.devnull) as nothing:  # noqa: PTH123
        monkeypatch.setattr(sys, "stdin", nothing)
        with pytest.raises(InputError, match=r"distance: no answer on standard input; pass --answer distance="):
            await TerminalPanel([]).number(DISTANCE)


def test_an_answer_has_a_name():
    with pytest.raises(InputError, match=r"--answer 2\.0: expected NAME=VALUE"):
        TerminalPanel(["2.0"])


def test_an_answer_nobody_asked_for_is_reported(capsys):
    with TerminalPanel(["distnace=1.98"]):
        pass
    assert "--answer distnace=1.98: the wizard did not ask for it" in capsys.readouterr().err
