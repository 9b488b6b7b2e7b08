"""Wizards through the whole daemon, in a world that hides the true values; and everything that can end one half-way."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import ConfigError, InputError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_sim.world.obstacles import Box
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result, WizardName
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate import steering
from monstertruckd.tools.calibrate.battery import BatteryWizard
from monstertruckd.tools.calibrate.compass import CompassWizard
from monstertruckd.tools.calibrate.drive import DriveWizard
from monstertruckd.tools.calibrate.steering import SteeringWizard
from monstertruckd.tools.calibrate.wizard import calibrate
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import (
    LocalTruck,
    Session,
    SilentTruck,
    SimulatedOperator,
    distance_from_fit,
    hidden,
    run_session,
    verdicts,
)

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(600)]

YARD = load_config(Path(__file__).resolve().parents[2] / "configs" / "yard.yaml", SimulatedTruckConfig)[0]
OLD = Result(
    wizard="drive",
    measured="long ago",
    estimates=(Estimate(name="drive_ratio", value=640.0, samples=4, meaning="test", key="geometry.drive_ratio"),),
)


def yard(folder: Path, seed: int, *parts: WizardName) -> tuple[SimulatedTruckConfig, np.random.Generator]:
    rng = np.random.default_rng(seed)
    plain = SimulatedTruckConfig.model_validate(
        YARD.model_dump() | {"sim": {"world": {"map": "yard"}}, "state_directory": folder, "recorder": None}
    )
    return hidden(plain, rng, seed, parts), rng


def judged(session: Session, config: SimulatedTruckConfig) -> None:
    found = verdicts(session.result, config)
    assert found
    assert all(verdict.holds for verdict in found), [verdict for verdict in found if not verdict.holds]
    assert session.plot is not None
    assert distance_from_fit(session.plot) < 0.05


# The truth lies within the stated interval


def test_battery(tmp_path: Path):
    config, rng = yard(tmp_path, 1, "battery")
    once = run_session(config, BatteryWizard(), rng)
    judged(once, config)
    again = run_session(config, BatteryWizard(), rng, charges=(0.2,))
    judged(again, config)
    assert len(again.result.readings) == 3, "the earlier reading counts too"
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    assert current.number == 2


def test_battery_by_a_converter_of_the_kernel(tmp_path: Path):
    config, rng = yard(tmp_path, 5, "battery")
    converter = with_overlay(
        config,
        {
            "devices": {"steering": {"driver": {"battery": None}}},
            "monitors": {"battery": {"kind": "iio", "channel": 5}},
        },
    )
    gain, offset = run_session(converter, BatteryWizard(), rng).result.estimates
    assert (gain.key, offset.key) == ("monitors.battery.divider", "monitors.battery.offset")
    assert gain.low is not None
    assert gain.high is not None
    assert gain.low < converter.sim.world.battery.divider < gain.high


@pytest.mark.long
def test_compass(tmp_path: Path):
    config, rng = yard(tmp_path, 1, "compass")
    blind = with_overlay(config, {"devices": {"lidar": None}, "gate": {"scan": {"critical": False}}})
    judged(run_session(blind, CompassWizard(speed=0.14), rng), config)


@pytest.mark.long
def test_drive_whose_sign_is_wrong_and_whose_next_start_is_right(tmp_path: Path):
    config, rng = yard(tmp_path, 5, "drive")
    assert config.sim.world.truck.motor.inverted is False
    wizard = DriveWizard(runs=3)
    sign = run_session(config, wizard, rng)
    assert sign.result.again is not None, "with the sign wrong nothing else is driven"
    assert [e.name for e in sign.result.estimates] == ["inverted"]
    session, again = (run_session(config, wizard, rng) for _ in range(2))
    judged(session, config)
    assert len(session.result.estimates) == 4 + 6
    first, second = (s.result.estimate("drive_ratio") for s in (session, again))
    assert first is not None
    assert second is not None
    assert second.value == pytest.approx(first.value, rel=0.005), "measured anew with the calibrated drive"


@pytest.mark.long
def test_steering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A truck one of whose axles turns the wrong way."""
    monkeypatch.setattr(steering, "FULL", 0.24)  # circles take half the time
    config, rng = yard(tmp_path, 6, "steering")
    wizard = SteeringWizard(strings=2, weaves=1)
    session = run_session(config, wizard, rng)
    world = config.sim.world.truck
    assert world.front_servo.us_per_degree > 0 > world.rear_servo.us_per_degree
    assert session.result.again is not None, "a restart turns wrong directions round"
    judged(session, config)
    session = run_session(config, wizard, rng)
    judged(session, config)
    assert session.result.again is None


@pytest.mark.long
def test_everything_hidden_at_once_begins_with_what_needs_nothing_else(tmp_path: Path):
    config, rng = yard(tmp_path, 8, "compass", "drive", "steering")
    for wizard in (DriveWizard(sign_only=True), SteeringWizard(rough=True)):
        judged(run_session(config, wizard, rng), config)
    judged(run_session(config, CompassWizard(), rng), config)
    judged(run_session(config, DriveWizard(runs=3), rng), config)


# Half-way


class Bench:
    """One truck with an old calibration, and a wizard that is about to be disturbed."""

    def __init__(self, rig: VirtualRig, clock: VirtualClock) -> None:
        self.rig = rig
        self.clock = clock
        self.truck = SilentTruck(rig.daemon, clock)
        self.store = CalibrationStore(rig.config.calibration_folder, rig.config.robot)
        self.files = {path: path.read_bytes() for path in self.store.files()}
        self.gate = rig.bus.subscribe(topics.GATE, latest())
        self.drives = rig.bus.subscribe(topics.CMD_DRIVE, fifo(1 << 14))
        self.operator = LocalOperator(rig.daemon, clock, "somebody", Role.GAMEPAD)

    @property
    def speed(self) -> float:
        return abs(self.rig.world.truth(self.clock.now()).v)

    async def until_it_drives(self) -> None:
        async with asyncio.timeout(30):
            while self.speed < 0.1:
                await self.clock.sleep(0.05)

    async def neutral(self) -> None:
        """At rest soon, with nothing more asked of the motor and the gate closed."""
        await self.clock.sleep(1.5)
        assert self.speed < 0.005
        self.drives.drain()
        await self.clock.sleep(1.0)
        assert all(command.motor_velocity == 0.0 for command in self.drives.drain())
        assert self.gate.latest is not None
        assert self.gate.latest.mode in (GateMode.DISARMED, GateMode.ESTOPPED)
        assert {path: path.read_bytes() for path in self.store.files()} == self.files, "the old file is intact"


@asynccontextmanager
async def driving(config: SimulatedTruckConfig, clock: VirtualClock) -> AsyncIterator[tuple[Bench, asyncio.Task[Any]]]:
    """The drive wizard in the middle of its first run."""
    CalibrationStore(config.calibration_folder, config.robot).save(OLD, 0)
    rig = VirtualRig(config, clock)
    async with rig.running():
        await clock.sleep(3.0)
        bench = Bench(rig, clock)
        panel = SimulatedOperator(rig, np.random.default_rng(1))
        steps = calibrate(DriveWizard(), bench.truck, panel, clock, config, {})
        wizard = asyncio.create_task(steps)
        try:
            await bench.until_it_drives()
            yield bench, wizard
        finally:
            wizard.cancel()
            await asyncio.wait([wizard])


def disturbed(folder: Path, disturb: Callable[[Bench, asyncio.Task[Any]], Awaitable[object]]) -> BaseException | None:
    """Disturb the wizard; what it ended with, the truck being neutral and the old file intact."""
    config, _ = yard(folder, 1)

    async def main(clock: VirtualClock) -> BaseException | None:
        async with driving(config, clock) as (bench, wizard):
            await disturb(bench, wizard)
            await asyncio.wait([wizard], timeout=10.0)
            assert wizard.done()
            await bench.neutral()
            return None if wizard.cancelled() else wizard.exception()

    return run_virtual(main)


async def interrupt(_: Bench, wizard: asyncio.Task[Any]) -> None:
    wizard.cancel()


async def pull_the_drive(bench: Bench, _: asyncio.Task[Any]) -> None:
    bench.rig.context.device("drive").port.unplug()
    await bench.clock.sleep(1.0)
    bench.rig.context.device("drive").port.plug()  # its motor kept its speed: the driver's first bytes stop it


async def pull_the_steering(bench: Bench, _: asyncio.Task[Any]) -> None:
    bench.rig.context.device("steering").port.unplug()


async def emergency_stop(bench: Bench, _: asyncio.Task[Any]) -> None:
    await bench.operator.estop()


async def put_something_before_it(bench: Bench, _: asyncio.Task[Any]) -> None:
    truth = bench.rig.world.truth(bench.clock.now())
    bench.rig.world.add(bench.clock.now(), Box(truth.x + 0.75, truth.y, 0.1, 0.6, 0.0))


def test_an_interrupt_leaves_truck_and_file_as_they_were(tmp_path: Path):
    assert disturbed(tmp_path, interrupt) is None


@pytest.mark.parametrize(
    ("disturb", "reason", "said"),
    [
        (pull_the_drive, Reason.DRIVE_STALE, "stopped by the gate: no fresh drive feedback"),
        pytest.param(
            pull_the_steering,
            Reason.STEERING_STALE,
            "stopped by the gate: no fresh steering feedback",
            marks=pytest.mark.long,
        ),
        (emergency_stop, Reason.ESTOPPED, "stopped by the gate: emergency stop is latched"),
    ],
)
def test_what_stops_the_truck_ends_the_wizard(disturb: Any, reason: Reason, said: str, tmp_path: Path):
    error = disturbed(tmp_path, disturb)
    assert isinstance(error, RequestRefusedError)
    assert error.refusal is reason
    assert said in str(error)


def test_an_obstacle_ends_the_wizard(tmp_path: Path):
    error = disturbed(tmp_path, put_something_before_it)
    assert isinstance(error, TruckError)
    assert "no progress for 3 s (obstacle within the stopping distance" in str(error)


def test_a_wizard_that_falls_silent_is_stopped_by_its_lease(tmp_path: Path):
    """As after kill -9: no order of its own ends it."""
    config, _ = yard(tmp_path, 1)

    async def main(clock: VirtualClock) -> None:
        async with driving(config, clock) as (bench, _):
            bench.truck.silent = True
            await bench.neutral()

    run_virtual(main)


class Distant(LocalTruck):
    """Orders take a while to arrive."""

    async def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> GateState:
        await self._clock.sleep(0.2)
        return await super().order(order, hold=hold, calibrates=calibrates)


def test_the_end_of_a_move_is_not_taken_for_the_begin_of_the_next(tmp_path: Path):
    config, _ = yard(tmp_path, 1)

    async def main(clock: VirtualClock) -> Result:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(3.0)
            truck, panel = Distant(rig.daemon, clock), SimulatedOperator(rig, np.random.default_rng(1))
            wizard = DriveWizard(runs=3, metres=0.5)
            result, _ = await calibrate(wizard, truck, panel, clock, config, {})
            return result

    assert len(run_virtual(main).estimates) == 4 + 6


def test_a_truck_that_somebody_has_armed_is_left_alone(tmp_path: Path):
    config, _ = yard(tmp_path, 1)

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(3.0)
            await LocalOperator(rig.daemon, clock).arm()
            await clock.sleep(0.2)
            truck, panel = LocalTruck(rig.daemon, clock), SimulatedOperator(rig, np.random.default_rng(1))
            with pytest.raises(RequestRefusedError, match="already armed") as refusal:
                await calibrate(DriveWizard(), truck, panel, clock, config, {})
            assert refusal.value.refusal is Reason.BUSY
            with pytest.raises(RequestRefusedError, match="disarm it before saving"):
                await truck.call("calibration_undo", {"wizard": "drive"})

    run_virtual(main)


# What the daemon takes


def asked(folder: Path, ask: Callable[[LocalTruck], Awaitable[Any]]) -> Any:
    config, _ = yard(folder, 1)

    async def main(clock: VirtualClock) -> Any:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(0.5)
            return await ask(LocalTruck(rig.daemon, clock))

    return run_virtual(main)


def test_the_daemon_tells_saves_and_undoes(tmp_path: Path):
    async def ask(truck: LocalTruck) -> Any:
        before = await truck.call("calibration")
        saved = await truck.call("calibration_save", {"result": OLD.model_dump(mode="json")})
        undone = await truck.call("calibration_undo", {"wizard": "drive"})
        return before, saved, undone, await truck.call("calibration")

    before, saved, undone, after = asked(tmp_path, ask)
    assert (before["newest"], before["content"], before["loaded"]) == (None, None, None)
    assert before["folder"] == str(tmp_path / "calibration")
    assert Path(saved["file"]).exists()
    assert after["newest"] == undone["file"] != saved["file"]
    assert after["content"]["results"] == {}


@pytest.mark.parametrize(
    ("result", "said"),
    [
        (None, "result"),
        ({**OLD.model_dump(mode="json"), "wizard": "warp"}, "wizard"),
        ({**OLD.model_dump(mode="json"), "estimates": []}, "estimates"),
    ],
)
def test_a_strange_result_is_refused(result: Any, said: str, tmp_path: Path):
    with pytest.raises(InputError, match=said):
        asked(tmp_path, lambda truck: truck.call("calibration_save", {"result": result}))
    assert not (tmp_path / "calibration").exists()


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("gate.speed", 9.0, "the wizard drive may not set gate.speed"),
        ("geometry.drive_ratio", -3.0, "greater than or equal to 1"),
    ],
)
def test_a_value_that_may_not_be_set_or_does_not_fit_is_refused(key: str, value: float, said: str, tmp_path: Path):
    estimate = OLD.estimates[0].model_copy(update={"key": key, "value": value})
    result = OLD.model_copy(update={"estimates": (estimate,)}).model_dump(mode="json")
    with pytest.raises(ConfigError, match=said):
        asked(tmp_path, lambda truck: truck.call("calibration_save", {"result": result}))
    assert not (tmp_path / "calibration").exists()


def test_a_wizard_needs_its_device(tmp_path: Path):
    config, rng = yard(tmp_path, 1)
    blind = config.model_copy(update={"devices": config.devices.model_copy(update={"compass": None})})
    with pytest.raises(InputError, match=r"devices\.compass\.driver\.rate: not in this robot's configuration"):
        run_session(blind, CompassWizard(), rng)
