"""Stops of the whole daemon, reported with their causes and kept in black boxes, on the virtual clock."""

import asyncio
import os
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.event import Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, Order
from monstertruck_schemas.state import GateMode
from monstertruckd.config.load import load_config
from monstertruckd.daemon import Daemon
from monstertruckd.gate.latch import EstopLatch
from monstertruckd.recorder.black_box import black_boxes
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.recorder import Recorder
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@cache
def base(name: str) -> SimulatedTruckConfig:
    return load_config(CONFIGS / f"{name}.yaml", SimulatedTruckConfig)[0]


class Drive:
    """A truck that drives its path, until something happens."""

    def __init__(self, rig: VirtualRig) -> None:
        self.rig = rig
        self.clock: VirtualClock = rig.clock
        self.operator = LocalOperator(rig.daemon, rig.clock)
        self._stops = rig.bus.subscribe(topics.STOP, fifo(64))
        self._gate = rig.bus.subscribe(topics.GATE, fifo(4096))
        self.stops: list[Stop] = []

    async def begin(self, seconds: float = 1.5) -> None:
        """Arm as soon as that is possible, then drive for so long."""
        for _ in range(200):
            with suppress(RequestRefusedError):
                await self.operator.arm()
            await self.clock.sleep(0.1)
            state = self._gate.latest
            if state is not None and state.mode is GateMode.DRIVING:
                await self.clock.sleep(seconds)
                return
        pytest.fail("does not drive")

    def news(self) -> list[Stop]:
        self.stops += self._stops.drain()
        return self.stops


def test_a_lost_hub_is_reported_behind_the_stop_and_the_box_holds_what_led_to_it(tmp_path: Path):
    config = with_overlay(base("full"), {"recorder": {"directory": str(tmp_path)}, "map": None})

    async def main(clock: VirtualClock) -> list[Stop]:
        rig = VirtualRig(config, clock)
        drive = Drive(rig)
        async with rig.running():
            await drive.begin()
            rig.computer.usb.lose_hub("1-2")
            await clock.sleep(6.0)
            assert [box.reason for box in black_boxes(tmp_path / "blackbox")] == ["scan_stale"]
            return drive.news()

    first, better = run_virtual(main)
    assert [cause.reason for cause in first.causes] == [Reason.SCAN_STALE, Reason.DEVICE_LOST]
    assert [(cause.reason, cause.because) for cause in better.causes] == [
        (Reason.SCAN_STALE, 1),
        (Reason.DEVICE_LOST, 2),
        (Reason.HUB_LOST, None),
    ]
    assert first.number == better.number
    assert first.black_box == better.black_box == "blackbox-000001-scan_stale.mcap"
    assert first.holder == "tracker"
    box = open_log(tmp_path / "blackbox" / "blackbox-000001-scan_stale.mcap")
    heard = {message.topic for message in box}
    assert box.damage is None
    assert {"sensor/scan", "sensor/camera", "sensor/drive", "cmd/drive", "state/gate", "event/stop"} <= heard
    assert box.attachments().keys() == {"config.json", "calibration.json", "origins.json", "versions.json"}
    (log,) = tmp_path.glob("*.mcap")
    saved = [m.decode() for m in open_log(log) if m.topic == "event/event" and b"black_box_saved" in m.payload]
    assert [event.model_dump()["values"]["file"] for event in saved] == [first.black_box]


def shutdown_after_estop(folder: Path) -> tuple[str, bytes]:
    """Digest of the log and the black box of a run that ends in the instant of its emergency stop."""
    config = with_overlay(base("demo"), {"recorder": {"directory": str(folder)}, "map": None})

    async def main(clock: VirtualClock) -> str:
        rig = VirtualRig(config, clock)
        drive = Drive(rig)
        async with rig.running():
            await drive.begin()
            stopping = asyncio.create_task(drive.operator.estop())
            await asyncio.sleep(0)  # published, not answered yet
        stopping.cancel()
        (stop,) = drive.news()
        assert (stop.reason, stop.quick) == (Reason.ESTOP_REQUESTED, True)
        return rig.daemon.digest.hexdigest()

    digest = run_virtual(main)
    (box,) = black_boxes(folder / "blackbox")
    assert box.reason == "estop_requested"
    messages = [message for message in open_log(box.path) if message.topic == "cmd/drive"]
    assert b"quick_stop" in messages[-1].payload, "the farewell is in it"
    return digest, b"".join(message.payload for message in open_log(box.path))


def three_seconds(folder: Path) -> str:
    """Digest of a short run of the whole truck with its hubs and its computer."""
    config = with_overlay(base("full"), {"recorder": {"directory": str(folder)}, "map": None})

    async def main(clock: VirtualClock) -> str:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(3.0)
        return rig.daemon.digest.hexdigest()

    return run_virtual(main)


def test_the_whole_truck_records_the_same_whatever_the_real_computer_does(tmp_path: Path, monkeypatch):
    first = three_seconds(tmp_path / "a")
    found = os.statvfs(tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_frsize=1, f_blocks=found.f_blocks, f_bavail=7))
    assert three_seconds(tmp_path / "b") == first


def test_an_emergency_stop_and_the_end_at_once_leave_a_box_the_same_in_every_run(tmp_path: Path):
    assert shutdown_after_estop(tmp_path / "a") == shutdown_after_estop(tmp_path / "b")


def test_an_emergency_stop_while_the_log_is_being_finished_is_latched(tmp_path: Path, monkeypatch):
    (tmp_path / "run").mkdir()
    config = with_overlay(base("demo"), {"recorder": {"directory": str(tmp_path / "logs")}, "map": None})

    def new_latch() -> EstopLatch:
        latch = EstopLatch(tmp_path / "state" / "estop", tmp_path / "run")
        latch.prepare()
        return latch

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        operator = LocalOperator(rig.daemon, clock)
        finish = Recorder.__aexit__

        async def stop_and_finish(recorder: Recorder, *error: object) -> None:
            header = await operator.header()
            rig.bus.inject(topics.REQ_CONTROL, ControlRequest(**header, order=Order.ESTOP))
            assert new_latch().engaged(), "marked at once"
            await finish(recorder, *error)

        monkeypatch.setattr(Recorder, "__aexit__", stop_and_finish)
        async with rig.running():
            await clock.sleep(1.0)

    monkeypatch.setattr(Daemon, "_build_latch", lambda *_: new_latch())
    run_virtual(main)
    assert new_latch().stored()
