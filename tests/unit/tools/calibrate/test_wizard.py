"""The frame: typed steps with bounds, cancelled anywhere, nothing saved before the end."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, BatteryLevel
from monstertruckd.config.calibration import Estimate, Result, ValidUntil
from monstertruckd.config.expiry import part_of
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.steps import Collect, Confirm, MoveRecord, MoveStep, Number
from monstertruckd.tools.calibrate.wizard import WizardContext, calibrate

CONFIG = load_config(Path(__file__).resolve().parents[4] / "configs" / "demo.yaml", TruckConfig)[0]
RESULT = Result(
    wizard="battery", measured="test", estimates=(Estimate(name="gain", value=1.1, samples=1, meaning="test"),)
)
DATE = "2026-11-22T12:00:00Z"


class Truck:
    source = "test"

    def __init__(self) -> None:
        self.calls: list[tuple[str, Any]] = []
        self.boxes: list[Mailbox[Any]] = []

    def subscribe(self, topic, delivery):
        self.boxes.append(Mailbox(delivery))
        return self.boxes[-1]

    async def drive(self, speed, front, rear=0.0, lease=0.3):
        raise AssertionError("nothing moves here")

    async def order(self, order, lease=1.0, *, hold=False, calibrates=False):
        raise AssertionError("nothing moves here")

    async def call(self, rpc, payload=None):
        self.calls.append((rpc, payload))
        return {"file": "0001.json", "result": payload["result"] | {"date": DATE}}


class Panel:
    def __init__(self, *, number: float = 1.0, yes: bool = True) -> None:
        self.said: list[str] = []
        self._number = number
        self._yes = yes

    def say(self, text):
        self.said.append(text)

    def progress(self, name, done, total):
        self.said.append(f"{name} {done:g}/{total:g}")

    def plot(self, plot):
        self.said.append(plot.name)

    async def number(self, step):
        return self._number

    async def confirm(self, step):
        return self._yes


def run(steps, panel: Panel | None = None, truck: Truck | None = None, known=None):
    """Run a wizard of the given coroutine function; returns what ``calibrate`` does."""

    class Steps:
        name, doc, room = "battery", "test", "a table"

        async def __call__(self, context):
            return await steps(context)

    async def main(clock: VirtualClock):
        return await calibrate(Steps(), truck or Truck(), panel or Panel(), clock, CONFIG, known or {})

    return run_virtual(main)


def test_the_result_is_saved_by_the_daemon_at_the_end():
    truck, panel = Truck(), Panel()

    async def steps(context: WizardContext) -> Result:
        assert not truck.calls
        return context.fit("scale", lambda: RESULT)

    assert run(steps, panel, truck) == (RESULT.model_copy(update={"date": DATE}), "0001.json")
    assert truck.calls == [("calibration_save", {"result": RESULT.model_dump(mode="json"), "source": "test"})]
    assert panel.said == ["battery: test", "room: a table", "computing: scale"]


@pytest.mark.parametrize("panel", [Panel(number=3.0), Panel(number=-1.0)])
def test_a_number_has_bounds(panel: Panel):
    truck = Truck()

    async def steps(context: WizardContext) -> Result:
        await context.ask(Number("volts", "volts?", 0.0, 2.0))
        return RESULT

    with pytest.raises(InputError, match=r"volts: .* is not within 0 to 2"):
        run(steps, panel, truck)
    assert not truck.calls


def test_no_to_what_has_to_be_ends_the_wizard():
    async def steps(context: WizardContext) -> Result:
        assert not await context.confirm(Confirm("seen", "did it?", fact=True)), "a fact may be either"
        await context.confirm(Confirm("ready", "ready?"))
        return RESULT

    truck = Truck()
    with pytest.raises(RequestRefusedError, match=r"cancelled at: ready\?") as caught:
        run(steps, Panel(yes=False), truck)
    assert caught.value.refusal is Reason.CANCELLED
    assert not truck.calls


def test_messages_are_collected_within_their_time():
    truck, panel = Truck(), Panel()

    async def steps(context: WizardContext) -> Result:
        collecting = asyncio.ensure_future(context.collect(Collect("voltage", topics.BATTERY, 3, 5.0)))
        await asyncio.sleep(0)
        message = Battery(stamp=1, received=1, seq=0, raw_voltage=24.0, cells=6, level=BatteryLevel.NORMAL)
        for _ in range(3):
            truck.boxes[0].put(message)
            await asyncio.sleep(0.1)
        assert await collecting == [message] * 3
        await context.collect(Collect("voltage", topics.BATTERY, 3, 5.0))
        return RESULT

    with pytest.raises(NoAnswerError, match="sensor/battery: 0 of 3 messages received within 5 s"):
        run(steps, panel, truck)
    assert "voltage 3/3" in panel.said


@pytest.mark.parametrize("part", ["maestro of another truck", None])
def test_what_was_measured_on_another_part_is_not_used(part: str | None):
    until = ValidUntil(date="2099-01-01T00:00:00Z", part=part or part_of(CONFIG, "steering"))
    estimate = RESULT.estimates[0].model_copy(update={"valid_until": until})
    known = {"battery": RESULT.model_copy(update={"estimates": (estimate,)})}
    panel = Panel()

    async def steps(context: WizardContext) -> Result:
        assert context.known.keys() == (set() if part else {"battery"})
        return RESULT

    run(steps, panel, known=known)
    said = [text for text in panel.said if "has expired" in text]
    assert len(said) == (1 if part else 0)
    assert not part or said[0].startswith(
        "the previous calibration is ignored because it has expired: steering was mae"
    )


def test_measurements_that_determine_nothing_are_named_and_not_saved():
    truck = Truck()

    async def steps(context: WizardContext) -> Result:
        return context.fit("scale", lambda: RESULT.model_copy(update={"date": 1 / 0}))

    with pytest.raises(InputError, match=r"scale: cannot be computed from the measurement .*: measure again"):
        run(steps, truck=truck)

    async def infinite(context: WizardContext) -> Result:
        return context.fit("scale", lambda: Estimate(name="gain", value=1.0, low=float("nan"), samples=1, meaning="t"))

    with pytest.raises(InputError, match="scale: cannot be computed"):
        run(infinite, truck=truck)
    assert not truck.calls


def test_values_of_the_running_configuration():
    async def steps(context: WizardContext) -> Result:
        assert context.value("geometry.drive_ratio") == 644.0
        context.value("devices.camera.driver.rate")
        return RESULT

    with pytest.raises(InputError, match=r"devices\.camera\.driver\.rate: not in this robot's configuration"):
        run(steps)


def test_moves_say_how_many_there_are():
    async def steps(context: WizardContext):
        async def moved(*_):
            return MoveRecord()

        context._mover.move = moved
        context.expect(2)
        for name in ("left", "right", "once more"):
            await context.move(MoveStep(name, 0.1))
        return RESULT

    run(steps, panel := Panel())
    assert panel.said[-3:] == ["moving (1 of 2): left", "moving (2 of 2): right", "moving: once more"]
