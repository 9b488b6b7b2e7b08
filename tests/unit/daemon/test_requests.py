"""What the composed daemon does with requests at the instant they arrive."""

import asyncio
from contextlib import nullcontext
from pathlib import Path

import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, GoalRequest, Order, Role
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import EVENT, REQ_CONTROL, REQ_GOAL
from monstertruckd.config.load import load_truck
from monstertruckd.daemon import Daemon, acknowledging

DEMO = Path(__file__).resolve().parents[3] / "configs" / "demo.yaml"
HEADER = {"stamp": 1, "received": 1, "seq": 1, "source": "ann", "role": Role.STATION, "lease": 1.0, "nonce": "any"}


def with_daemon(tmp_path: Path, check) -> None:
    async def main(clock: VirtualClock) -> None:
        config, _ = load_truck(DEMO)
        quiet = config.model_copy(update={"state_directory": tmp_path, "recorder": None})
        check(Daemon(quiet, clock, seed=1))

    run_virtual(main)


def test_an_emergency_stop_is_carried_out_before_the_bus_returns(tmp_path: Path):
    def check(daemon: Daemon) -> None:
        for order in (Order.ESTOP, *[Order.ARM] * 16):
            daemon.bus.inject(REQ_CONTROL, ControlRequest(**HEADER, order=order))
        assert daemon.gate.mode is GateMode.ESTOPPED

    with_daemon(tmp_path, check)


def test_the_gate_takes_every_health_table(tmp_path: Path):
    def check(daemon: Daemon) -> None:
        for state, reason in ((ServiceState.BACKOFF, Reason.DEVICE_RESTARTED), (ServiceState.STARTING, Reason.OK)):
            daemon._board.report(ServiceHealth(name="drive", state=state, since=1, reason=reason))
        authentic = {**HEADER, "nonce": daemon.gate._gate.nonce, "gate_stamp": daemon.clock.now()}
        assert daemon.gate.control(ControlRequest(**authentic, order=Order.ARM)).reason is Reason.DEVICE_RESTARTED

    with_daemon(tmp_path, check)


@pytest.mark.parametrize("count", [1, 3])
def test_every_goal_is_answered(tmp_path: Path, count: int):
    def check(daemon: Daemon) -> None:
        events = daemon.bus.subscribe(EVENT, fifo(9))
        for _ in range(count):
            daemon.bus.inject(REQ_GOAL, GoalRequest(**HEADER, frame="map", goal=Pose2D(x=1.0, y=2.0, yaw=0.0)))
        reported = events.drain()
        assert [event.reason for event in reported] == [Reason.NOT_SUPPORTED] * count
        assert "ann" in reported[0].text

    with_daemon(tmp_path, check)


@pytest.mark.parametrize(
    ("text", "seen"), [("tilt", True), ("", False), (None, False), ("x" * 201, False), ("a\nb", False)]
)
def test_a_warning_that_was_seen_is_an_event(text: str | None, seen: bool):
    events: list[tuple[object, ...]] = []
    acknowledge = acknowledging(lambda *event, **values: events.append((*event, values)))
    with nullcontext() if seen else pytest.raises(InputError, match="1 to 200 printable"):
        asyncio.run(acknowledge({"text": text, "source": "ann"}))
    expected = (Reason.ACKNOWLEDGED, Severity.INFO, "operator", "ann acknowledged: tilt", {"by": "ann"})
    assert events == ([expected] if seen else [])
