"""The zone service: what it publishes, the operators' orders, and what they are refused for."""

import json
from pathlib import Path

import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_planners.zones.config import ZonesConfig
from monstertruck_planners.zones.service import ZoneInputs, ZoneService
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import DamagedFileError, InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.threads import inline
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruck_schemas.topics import Writer
from monstertruck_schemas.zones import ZoneArea, ZoneOrder, ZoneRequest
from monstertruckd.bus.local import Bus
from tests.unit.planners.zones.zone_kit import SQUARE

AREA = ZoneArea(kind="keepout", corners=SQUARE)
SLOW = ZoneArea(kind="speed", corners=((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)), limit=0.1)


class Stage:
    """A service, its bus, and an operator."""

    def __init__(self, clock, file: Path | None = None, **areas: ZoneArea):
        self.clock, self.bus = clock, Bus(clock)
        self.gate, self.pose = (
            self.bus.publisher(topics.GATE, Writer.GATE),
            self.bus.publisher(topics.POSE, Writer.ESTIMATION),
        )
        self.zones, self.events = self.bus.subscribe(topics.ZONES, latest()), []
        self.service = ZoneService(
            ZonesConfig(areas=areas),
            clock,
            max_speed=0.5,
            footprint=Footprint(),
            file=file,
            inputs=ZoneInputs(self.bus.subscribe(topics.GATE, latest()), self.bus.subscribe(topics.POSE, latest())),
            out=self.bus.publisher(topics.ZONES, Writer.PLANNER),
            events=lambda reason, severity, source, text="", **values: self.events.append((reason, text)),
            offload=inline,
            max_age=0.5,
        )
        self.seq = 0

    async def ask(self, order: ZoneOrder, name: str, area: ZoneArea | None = None, nonce="n", **more):
        now = self.clock.now()
        self.gate.put(
            GateState(
                stamp=now, received=now, seq=self.gate.next_seq(), mode=GateMode.DISARMED, nonce="n", speed_limit=0.0,
                reasons=(), stopping_distance=0.0,
            )
        )  # fmt: skip
        self.seq += 1
        await self.service.take(
            ZoneRequest(
                stamp=now, received=now, seq=self.seq, source="ann", role=Role.STATION, lease=1.0, nonce=nonce,
                order=order, name=name, area=area, **more,
            )
        )  # fmt: skip

    def stand(self, x: float) -> None:
        now = self.clock.now()
        self.pose.put(
            Odometry(
                stamp=now, received=now, seq=self.pose.next_seq(), frame="map", pose=Pose2D(x=x, y=0.0, yaw=0.0),
                twist=Twist2D(vx=0.0, vy=0.0, wz=0.0), pose_covariance=(0.0,) * 9, twist_covariance=(0.0,) * 9, age=0.0,
            )
        )  # fmt: skip

    @property
    def names(self) -> list[str]:
        return [zone.name for zone in self.zones.latest.zones]

    def reported(self) -> list[Reason]:
        return [reason for reason, _ in self.events]


def play(story, file=None, **areas):
    """Run ``story(stage)`` beside the service."""

    async def main(clock):
        import asyncio

        stage = Stage(clock, file, **areas)
        task = asyncio.ensure_future(stage.service.run(lambda: None))
        await clock.sleep(0.1)
        try:
            if task.done():
                task.result()
            await story(stage)
        finally:
            task.cancel()
        return stage

    return run_virtual(main, start=SECOND)


def test_an_operator_adds_zones_that_outlast_a_restart_and_removes_them(tmp_path):
    async def add(stage):
        assert stage.names == ["ramp"]
        await stage.ask(ZoneOrder.ADD, "stairs", AREA)
        assert stage.names == ["ramp", "stairs"]
        assert stage.zones.latest.zones[1].saved

    async def remove(stage):
        assert sorted(stage.names) == ["ramp", "stairs"]
        await stage.ask(ZoneOrder.REMOVE, "stairs")
        assert stage.names == ["ramp"]

    file = tmp_path / "zones.json"
    assert play(add, file, ramp=SLOW).reported() == [Reason.ZONE_CHANGED]
    assert list(json.loads(file.read_text())["zones"]) == ["stairs"]
    play(remove, file, ramp=SLOW)
    assert json.loads(file.read_text())["zones"] == {}


def test_a_zone_is_off_for_a_while_or_until_it_is_turned_on():
    async def story(stage):
        await stage.ask(ZoneOrder.OFF, "stairs", seconds=5.0)
        assert stage.zones.latest.zones[0].off_until == stage.clock.now() + 5 * SECOND
        await stage.clock.sleep(5.3)
        assert stage.zones.latest.zones[0].off_until is None
        await stage.ask(ZoneOrder.OFF, "stairs")
        await stage.ask(ZoneOrder.ON, "stairs")
        await stage.ask(ZoneOrder.ON, "stairs")
        assert stage.zones.latest.zones[0].off_until is None

    stage = play(story, stairs=AREA)
    assert stage.reported() == [Reason.ZONE_OFF, Reason.ZONE_ON, Reason.ZONE_OFF, Reason.ZONE_ON]
    assert stage.events[0][1] == "keepout zone stairs is off for 5 s, by ann"
    assert stage.events[1][1] == "zone stairs is on: its time off has expired"


def test_the_zones_that_the_robot_is_in_are_said_once_each():
    async def story(stage):
        for x, inside in ((1.0, ()), (1.8, ("stairs",)), (1.74, ("stairs",)), (1.66, ())):
            stage.stand(x)
            await stage.clock.sleep(0.25)
            assert stage.zones.latest.inside == inside, x
            assert (x, stage.zones.latest.seq) in {(1.0, 0), (1.8, 1), (1.74, 1), (1.66, 2)}

    assert play(story, stairs=AREA).reported() == [Reason.ZONE_ENTERED, Reason.ZONE_LEFT]


def test_what_cannot_be_done_is_refused_and_changes_nothing(tmp_path):
    async def story(stage):
        for order, name, error, said in (
            (ZoneOrder.REMOVE, "ramp", InputError, "is defined in the configuration: expected to be removed there"),
            (ZoneOrder.OFF, "yard", NotFoundError, "no zone 'yard': expected one of ramp"),
            (ZoneOrder.ADD, "yard", InputError, "area: expected"),
        ):
            with pytest.raises(error, match=said):
                await stage.ask(order, name)
        for name, said in (("ramp", "expected to be replaced there"), ("speed_mask", "a mask has this one")):
            with pytest.raises(InputError, match=said):
                await stage.ask(ZoneOrder.ADD, name, AREA)
        with pytest.raises(RequestRefusedError) as refused:
            await stage.ask(ZoneOrder.OFF, "ramp", nonce="old")
        assert refused.value.refusal is Reason.BAD_NONCE
        with pytest.raises(RequestRefusedError, match="zones not saved") as refused:
            await stage.ask(ZoneOrder.ADD, "yard", AREA)
        assert refused.value.refusal is Reason.RECORDING_FAILED
        assert stage.names == ["ramp"]

    assert play(story, tmp_path / "none" / "zones.json", ramp=SLOW).reported() == []


def test_a_damaged_file_ends_the_service_with_its_name(tmp_path):
    file = tmp_path / "zones.json"
    file.write_text("[")

    async def never(stage):
        pytest.fail("it serves")

    with pytest.raises(DamagedFileError, match=r"zones\.json.*at rest"):
        play(never, file)
    assert file.read_text() == "["


def test_a_link_to_an_absent_disk_is_not_an_empty_list_of_zones(tmp_path):
    """A robot that takes it for one would drive down the stairs that the zones guard."""
    file = tmp_path / "zones.json"
    file.symlink_to(tmp_path / "not mounted" / "zones.json")

    async def never(stage):
        pytest.fail("it serves")

    with pytest.raises(DamagedFileError, match=r"zones\.json"):
        play(never, file)
