"""Paths from files and from outside: who may send them, when, and which can be tracked."""

import asyncio
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import PurePursuitConfig
from monstertruck_planners.track.drivable import require_drivable
from monstertruck_planners.track.paths import PathService, load_path
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.threads import inline
from monstertruck_schemas.event import Event
from monstertruck_schemas.plan import MAX_POSES, BehaviourState, Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import PathRequest, PathStart, Role
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import BEHAVIOUR, EVENT, GATE, PATH, REQ_PATH, Writer
from monstertruckd.bus.local import Bus
from tests.unit.planners.kit import path, straight

ROUTE = path(straight(1.0))


class Bench:
    """A path service and a gate that says what it is given."""

    def __init__(self, clock: VirtualClock, drawn: Path | None = None, *, at_once: bool = False) -> None:
        self.clock = clock
        self.bus = Bus(clock)
        self.published: Mailbox[Path] = self.bus.subscribe(PATH, fifo(20))
        self.events: Mailbox[Event] = self.bus.subscribe(EVENT, fifo(20))
        self.state = self.bus.publisher(GATE, Writer.GATE)
        self.service = PathService(
            drawn,
            at_once,
            clock,
            self.bus.subscribe(REQ_PATH, fifo(4)),
            self.bus.subscribe(GATE, latest()),
            self.bus.subscribe(BEHAVIOUR, latest()),
            self.bus.subscribe(PATH, latest()),
            self.bus.publisher(PATH, Writer.PLANNER),
            self.bus.event_sink(),
            0.5,
            partial(require_drivable, config=PurePursuitConfig(), geometry=FourWheelSteering()),
            inline,
        )
        self.seq, self.at_once = 0, at_once

    def gate(self, mode: GateMode) -> None:
        now = self.clock.now()
        self.state.put(GateState(stamp=now, received=now, seq=0, mode=mode, nonce="n1", speed_limit=0.2))

    def start(self, name: str, **more: Any) -> str:
        """Start the configured path; returns the name under which it is published."""
        now = self.clock.now()
        self.seq += 1
        fields = {"seq": self.seq, "source": "ann", "role": Role.STATION, "nonce": "n1", "gate_stamp": now, **more}
        return self.service.start(PathStart(stamp=now, received=now, lease=1.0, path=name, **fields))

    async def send(self, route: Path = ROUTE, **more: Any) -> Reason:
        """OK if the path was published."""
        now = self.clock.now()
        self.seq += 1
        fields = {"seq": self.seq, "source": "ann", "role": Role.STATION, "nonce": "n1", "gate_stamp": now, **more}
        self.bus.inject(REQ_PATH, PathRequest(stamp=now, received=now, lease=1.0, path=route, **fields))
        await self.clock.sleep(0.01)
        published, events = self.published.drain(), self.events.drain()
        assert len(published) + len(events) == 1
        return events[0].reason if events else Reason.OK


def on_bench(scenario: Any, **setup: Any) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, **setup)
        running = asyncio.create_task(bench.service.run(lambda: None))
        await clock.sleep(1.0)
        try:
            await scenario(bench)
            assert not running.done()
        finally:
            running.cancel()
            await asyncio.wait([running])

    run_virtual(main)


def test_a_path_needs_what_a_drive_request_needs():
    async def scenario(bench: Bench) -> None:
        assert await bench.send() is Reason.BAD_NONCE  # no gate yet
        bench.gate(GateMode.DISARMED)
        assert await bench.send(nonce="n0") is Reason.BAD_NONCE
        assert await bench.send(seq=10) is Reason.OK
        assert await bench.send(seq=10) is Reason.BAD_SEQUENCE
        assert await bench.send(seq=9) is Reason.BAD_SEQUENCE
        assert await bench.send(seq=9, source="bob") is Reason.OK
        bench.seq = 10
        assert await bench.send(gate_stamp=None) is Reason.LEASE_EXPIRED
        assert await bench.send(gate_stamp=bench.clock.now() - 6 * SECOND // 10) is Reason.LEASE_EXPIRED
        for role in (Role.TRACKER, Role.ESTOP):
            assert await bench.send(role=role) is Reason.BAD_ROLE
        for role in (Role.GAMEPAD, Role.KEYBOARD, Role.STATION):
            assert await bench.send(role=role) is Reason.OK

    on_bench(scenario)


def test_the_path_stays_as_it_is_while_the_truck_moves():
    async def scenario(bench: Bench) -> None:
        for mode in GateMode:
            bench.gate(mode)
            moving = mode in (GateMode.DRIVING, GateMode.STOPPING)
            assert await bench.send() is (Reason.BUSY if moving else Reason.OK)

    on_bench(scenario)


def test_a_path_is_withdrawn_while_the_truck_moves_but_no_other_one_by_its_name():
    async def scenario(bench: Bench) -> None:
        bench.gate(GateMode.ARMED)
        first, second = (path([[0.0, 0.0], [x, 0.0]]).model_copy(update={"name": f"{x}"}) for x in (1.0, 2.0))
        assert await bench.send(first) is Reason.OK
        assert await bench.send(second) is Reason.OK
        bench.gate(GateMode.DRIVING)
        withdrawn = {"halts": True, "poses": first.poses}
        assert await bench.send(first.model_copy(update=withdrawn)) is Reason.NOT_FOUND
        assert await bench.send(second.model_copy(update=withdrawn)) is Reason.OK
        newest = bench.bus.newest(PATH)
        assert (newest.halts, newest.poses.tolist()) == (True, second.poses.tolist())

    on_bench(scenario)


DRAWN = ROUTE.model_copy(update={"name": "lap"})


def test_a_configured_path_is_driven_by_arming_alone_only_where_it_is_followed_at_once():
    async def scenario(bench: Bench) -> None:
        bench.gate(GateMode.ARMED)
        await bench.clock.sleep(1.0)
        assert [one.name for one in bench.published.drain()] == (["lap"] if bench.at_once else [])

    for at_once in (True, False):
        on_bench(scenario, drawn=DRAWN, at_once=at_once)


def test_an_operator_starts_the_configured_path_by_name():
    async def scenario(bench: Bench) -> None:
        with pytest.raises(RequestRefusedError) as refused:
            bench.start("lap")
        assert refused.value.refusal is Reason.BAD_NONCE  # no gate yet
        for mode, reason in (
            (GateMode.DISARMED, Reason.DISARMED),
            (GateMode.DRIVING, Reason.BUSY),
        ):
            bench.gate(mode)
            with pytest.raises(RequestRefusedError) as refused:
                bench.start("lap")
            assert refused.value.refusal is reason
        bench.gate(GateMode.ARMED)
        with pytest.raises(NotFoundError, match="no path 'loop': the configuration has the path 'lap'"):
            bench.start("loop")
        with pytest.raises(RequestRefusedError) as refused:
            bench.start("lap", role=Role.TRACKER)
        assert refused.value.refusal is Reason.BAD_ROLE
        assert not bench.published.drain()
        names = []
        for _ in range(2):
            names.append(bench.start("lap"))
            await bench.clock.sleep(0.1)
            (path,) = bench.published.drain()
            assert path.name == names[-1]
            assert path.halts, "it is over once the robot is disarmed"
        assert names[0] != names[1], "driven again, not withdrawn"

    on_bench(scenario, drawn=DRAWN)


def test_without_a_configured_path_there_is_none_to_start():
    async def scenario(bench: Bench) -> None:
        bench.gate(GateMode.ARMED)
        with pytest.raises(NotFoundError, match="no path 'lap': the configuration has no path"):
            bench.start("lap")

    on_bench(scenario)


def with_pose(value: float) -> Path:
    return path([[0.0, 0.0], [1.0, 0.0], [value, 0.0]])


IMPOSSIBLE = {
    "huge": with_pose(1e308),
    "far": with_pose(10_001.0),
    "jump": with_pose(200.0),
    "nan": with_pose(float("nan")),
    "infinite": with_pose(float("inf")),
    "one pose": path([[0.0, 0.0]]),
    "standing": path([[1.0, 1.0], [1.0, 1.0]]),
    "too many": path(np.column_stack((np.arange(MAX_POSES + 1) * 0.01, np.zeros(MAX_POSES + 1)))),
    "wrong directions": path(straight(1.0), [1.0]),
    "odd directions": path([[0.0, 0.0], [1.0, 0.0]], [1.0, 0.5]),
    "wound up": path(straight(1.0), yaws=1e308),
    "too few clearances": ROUTE.model_copy(update={"clearance": np.zeros(2)}),
    "unknown clearance": ROUTE.model_copy(update={"clearance": np.full(len(ROUTE.poses) // 3, np.nan)}),
    "too few speeds": ROUTE.model_copy(update={"speeds": np.zeros(2)}),
    "negative speed": ROUTE.model_copy(update={"speeds": np.full(len(ROUTE.poses) // 3, -0.1)}),
    "zigzag": path(straight(10.0), [1.0 - 2.0 * (i % 2) for i in range(201)]),
    "long name": ROUTE.model_copy(update={"name": "x" * 129}),
    "fold": path([[0.0, 0.0], [2.0, 0.0], [0.0, 0.0]]),
    "odd count": ROUTE.model_copy(update={"poses": np.zeros(7)}),
    "long way back": path([[0.0, 0.0], [99.0, 0.0], [198.0, 0.0]], closed=True),
}


@pytest.mark.parametrize("route", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_what_cannot_be_tracked_is_refused(route: Path):
    async def scenario(bench: Bench) -> None:
        bench.gate(GateMode.DISARMED)
        assert await bench.send(route) is Reason.BAD_INPUT
        assert await bench.send() is Reason.OK

    on_bench(scenario)


def test_a_drawn_path_out_of_bounds_is_refused_by_file(tmp_path: FilePath):
    file = tmp_path / "far.csv"
    file.write_text("x,y,yaw,direction\n0,0,0,1\n1e308,0,0,1\n")
    with pytest.raises(InputError, match=r"far\.csv: path 'far': poses: expected finite ones, at most 10000 m"):
        load_path(file, closed=False)
    file.write_text("x,y,yaw,direction\n0,0,0,1\n1,0,0,1\n")
    assert load_path(file, closed=False).name == "far"


def test_a_running_behaviour_excludes_a_path():
    async def scenario(bench: Bench) -> None:
        bench.gate(GateMode.ARMED)
        out = bench.bus.publisher(BEHAVIOUR, Writer.PLANNER)
        for running, expected in ((True, Reason.BUSY), (False, Reason.OK)):
            now = bench.clock.now()
            out.put(BehaviourState(stamp=now, received=now, seq=0, behaviour="wall", running=running))
            assert await bench.send() is expected

    on_bench(scenario)
