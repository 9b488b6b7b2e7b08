"""Calibration from a browser; the wizard is played by the test."""

import asyncio
import json
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import InputError, NoAnswerError
from monstertruckd.station import commands
from monstertruckd.station.calibration import Calibration, Measured
from monstertruckd.station.viewer import Viewer
from monstertruckd.tools.calibrate.steps import Confirm, Number, Plot
from tests.unit.station.test_server import connected, serving

ROW = {"name": "gain", "value": 1.02, "low": 1.0, "high": 1.04, "unit": "", "meaning": "m", "grade": "A", "before": 1.0}
METER = Number("meter", "What does the meter show, V?", 5.0, 30.0)
ANOTHER = Confirm("another", "Another one?", fact=True)


class Wizards:
    """One wizard: a number, a yes or no, a move; ``fault`` ends it."""

    def __init__(self, fault: Exception | None = None) -> None:
        self.fault = fault
        self.saved = 0
        self.cancelled = False

    async def offered(self, truck: Any) -> list[dict[str, Any]]:
        return [{"id": "battery.gain", "name": "battery", "rough": False, "doc": "Scale.", "due": True}]

    async def measure(self, truck: Any, step: str, options: Any, panel: Any) -> Measured:
        self.options = options
        panel.say(f"{step} on {truck}")
        if self.fault is not None:
            raise self.fault
        try:
            volts = await panel.number(METER)
            more = await panel.confirm(ANOTHER)
        except asyncio.CancelledError:
            self.cancelled = True
            raise
        panel.progress("drive", 0.5, 1.0)
        points = np.vstack((np.linspace((0.0, 0.0), (300.0, 600.0), 301), (1.0, np.nan)))
        panel.plot(Plot("scale", "input (V)", "meter (V)", points, np.eye(2)))

        async def save() -> str:
            self.saved += 1
            return "0002.json"

        return Measured([ROW], f"{volts:g} V, {more}", save)


def calibration(wizards: Wizards) -> tuple[Calibration, Viewer]:
    viewer = Viewer()
    address: Any = SimpleNamespace(session=lambda program, clock, timeout: nullcontext(f"truck by {program}"))
    return Calibration(address, "ann.calibrate", WallClock(), wizards, viewer), viewer


async def state(viewer: Viewer) -> dict[str, Any]:
    """The newest state, once all that can run has run."""
    for _ in range(5):
        await asyncio.sleep(0)
    frame: dict[str, Any] = json.loads(await viewer.next())
    return frame


async def test_a_wizard_asks_shows_its_result_and_saves_it_once_it_is_accepted():
    wizards = Wizards()
    run, viewer = calibration(wizards)
    assert [row["id"] for row in await run.offer()] == ["battery.gain"]
    run.begin("battery.gain", {})
    asked = await state(viewer)
    assert (asked["phase"], asked["said"]) == ("running", ["battery.gain on truck by ann.calibrate"])
    assert asked["question"] == {
        "kind": "number", "name": "meter", "text": METER.question, "low": 5.0, "high": 30.0,
    }  # fmt: skip
    for wrong in (4.9, 31.0):
        with pytest.raises(InputError, match="meter: expected 5 to 30"):
            run.answer(wrong)
    run.answer(12.6)
    asked = await state(viewer)
    assert asked["said"][-1] == f"{METER.question} 12.6"
    with pytest.raises(InputError, match="another: expected yes or no"):
        run.answer(2.0)
    with pytest.raises(InputError, match="no result to accept"):
        run.decide(accept=True)
    run.answer(False)
    measured = await state(viewer)
    assert (measured["phase"], measured["question"]) == ("measured", None)
    drawn = measured["plot"]
    assert (drawn["name"], drawn["x"], drawn["y"]) == ("scale", "input (V)", "meter (V)")
    assert len(drawn["points"]) <= 200
    assert drawn["points"][-1] == [300.0, 600.0], "the last one"
    assert drawn["curve"] == [[1.0, 0.0], [0.0, 1.0]]
    assert measured["measured"] == {"rows": [ROW], "text": "12.6 V, False"}
    assert wizards.saved == 0
    with pytest.raises(InputError, match="not asking a question"):
        run.answer(1.0)
    with pytest.raises(InputError, match=r"battery\.gain is already running"):
        run.begin("battery.gain", {})
    run.decide(accept=True)
    saved = await state(viewer)
    assert (saved["phase"], saved["text"], wizards.saved) == ("saved", "0002.json", 1)


async def test_what_is_discarded_or_cancelled_is_not_saved():
    wizards = Wizards()
    run, viewer = calibration(wizards)
    run.begin("battery.gain", {})
    await state(viewer)
    run.answer(12.0)
    await state(viewer)
    run.answer(True)
    await state(viewer)
    run.decide(accept=False)
    assert (await state(viewer))["phase"] == "discarded"
    run.begin("battery.gain", {})
    await state(viewer)
    run.decide(accept=False)
    assert (await state(viewer))["phase"] == "discarded"
    assert wizards.cancelled
    assert wizards.saved == 0


async def test_a_browser_that_leaves_ends_its_wizard_and_a_failure_is_shown():
    wizards = Wizards()
    run, viewer = calibration(wizards)
    run.begin("battery.gain", {})
    await state(viewer)
    ended = run.end()
    assert ended is not None
    await asyncio.wait([ended])
    assert wizards.cancelled
    run, viewer = calibration(Wizards(NoAnswerError("sensor/battery: no message received for 10 s")))
    run.begin("battery.gain", {})
    failed = await state(viewer)
    assert (failed["phase"], failed["text"]) == ("failed", "sensor/battery: no message received for 10 s")


async def test_only_engineers_calibrate_and_a_station_without_wizards_says_so():
    order = commands.parse('{"do": "calibrate", "id": 1, "order": "list"}')
    assert commands.needed(order).value == "engineer"
    async with serving() as (station, session), connected(station, session) as socket:
        await socket.send_json({"do": "watch", "robot": station.names[0]})
        await socket.send_json({"do": "calibrate", "id": 1, "order": "list"})
        while (frame := await socket.receive_json(timeout=10))["kind"] != "answer":
            pass
        assert (frame["ok"], frame["text"]) == (False, "this station does not calibrate robots")
