"""A truck with a lidar at each end, through real drivers and emulators, on the virtual clock."""

import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.event import Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck
from tests.daemon.slam_kit import CONFIGS, driven, lap, share_beside_walls

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(240)]

TAIL = 0.235
"""Distance of the tail behind the base, m."""
WALL = -3.5
"""x of a wall of the yard, m."""
URG = {"kind": "hokuyo_urg"}
"""Counter-clockwise, over 240 degrees: a pair sees all around."""
LD19 = {"kind": "ld19"}
"""Clockwise, all around."""


def lidars(front: dict[str, Any], rear: dict[str, Any], **rear_mount: float) -> dict[str, Any]:
    """The section ``devices``."""
    back = {"x": -0.14, "z": 0.25, "yaw": math.pi, **rear_mount}
    return {
        "lidar": {"driver": front},
        "lidar_2": {"port": {"path": Path("/dev/truck/lidar_2")}, "mount": back, "driver": rear},
    }


def true(devices: dict[str, Any]) -> dict[str, Any]:
    """The simulated mount of the second lidar."""
    mount = dict(devices["lidar_2"]["mount"])
    return {"lidar_2": {"height": mount.pop("z"), **mount}}


def truck(devices: dict[str, Any], room: float) -> SimulatedTruckConfig:
    """The truck in the yard, its tail ``room`` metres before a wall."""
    overlay: dict[str, Any] = {
        "recorder": None,
        "map": None,
        "path": None,
        "tracker": None,
        "devices": devices,
        "sim": {"world": {"map": "yard", "start": {"x": WALL + TAIL + room, "y": 0.0, "yaw": 0.0}, **true(devices)}},
    }
    return with_overlay(load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)[0], overlay)


def tried(config: SimulatedTruckConfig, story: Callable[[VirtualRig, LocalTruck], Awaitable[None]]) -> list[Stop]:
    """Let a story happen to an armed truck that touches nothing; its stops."""

    async def main(clock: VirtualClock) -> list[Stop]:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.STOP, fifo(64)) as stops:
            async with rig.running():
                await clock.sleep(3.0)
                operator = LocalTruck(rig.daemon, clock)
                await operator.arm()
                await story(rig, operator)
                assert not rig.truth.array()[:, 5].any(), "touched"
                return stops.drain()

    return run_virtual(main, start=SECOND)


@pytest.mark.parametrize("rear", [URG, LD19])
def test_it_reverses_to_a_wall_that_only_the_rear_lidar_sees(rear):
    rooms: list[float] = []

    async def story(rig: VirtualRig, operator: LocalTruck) -> None:
        for _ in range(120):
            await operator.drive(-0.15, 0.0, 0.0)
            await rig.clock.sleep(0.1)
        rooms.append(rig.world.truth(rig.clock.now()).x - WALL - TAIL)

    tried(truck(lidars(URG, rear), 1.0), story)
    assert 0.03 < rooms[0] < 0.15, "with the front one alone the ground behind it is unseen"


@pytest.mark.parametrize("lost", ["lidar", "lidar_2"])
def test_it_stops_for_the_loss_of_either_and_names_it(lost):
    async def story(rig: VirtualRig, operator: LocalTruck) -> None:
        for step in range(25):
            if step == 10:
                rig.ports[lost].unplug()
            await operator.drive(0.15, 0.0, 0.0)
            await rig.clock.sleep(0.1)
        assert rig.world.truth(rig.clock.now()).v == pytest.approx(0.0, abs=1e-3)

    stops = tried(truck(lidars(URG, LD19), 1.0), story)
    cause = next(cause for stop in stops for cause in stop.causes if cause.reason is Reason.SCAN_STALE)
    assert cause.source == lost


@pytest.mark.parametrize("sense", ["clockwise", "counter_clockwise"])
def test_both_scans_show_the_room_in_their_frames_and_the_map_has_what_is_behind(sense):
    rear = {"kind": "sheet_lidar", "beams": 180, "direction": sense, "field_of_view": 3.14}
    config = {"devices": lidars(URG, rear), "slam": {"mode": "mapping", "map_period": 1.0}}
    drive = driven("demo.yaml", lap(12.0), topics.SCAN, topics.SCAN_2, topics.MAP, **config)
    front, back = (drive.said[topic.name] for topic in (topics.SCAN, topics.SCAN_2))
    assert {scan.frame for scan in front} == {"lidar"}
    assert {scan.frame for scan in back} == {"lidar_2"}
    assert all((scan.angle_increment > 0) == (sense == "counter_clockwise") for scan in back)
    assert share_beside_walls(drive.said[topics.MAP.name][-1], "loop") < 0.02
    assert drive.off(after=3.0).max() < 0.05


@pytest.mark.parametrize("driver", [URG, LD19])
def test_a_lidar_that_hangs_upside_down_shows_the_room_as_one_that_stands(driver):
    def shown(**mount: float) -> LaserScan:
        scans: list[LaserScan] = []

        async def story(rig: VirtualRig, operator: LocalTruck) -> None:
            with rig.bus.subscribe(topics.SCAN_2, fifo(64)) as box:
                await rig.clock.sleep(1.0)
                scans.extend(box.drain())

        tried(truck(lidars(URG, driver, **mount), 0.4), story)
        return scans[-1]

    standing, hanging = shown(), shown(roll=math.pi)
    assert (standing.angle_increment > 0) != (hanging.angle_increment > 0)
    bearings = np.radians(np.arange(-60, 60, 5))
    for bearing in bearings:
        one, other = (range_at(scan, bearing) for scan in (standing, hanging))
        assert one == pytest.approx(other, abs=0.1)


def range_at(scan: LaserScan, bearing: float) -> float:
    """Median of the ranges within two degrees of a bearing, m."""
    ways = scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges))
    near = np.abs(np.remainder(ways - bearing + math.pi, math.tau) - math.pi) < math.radians(2.0)
    return float(np.median(scan.ranges[near & (scan.codes == VALID_BEAM)]))


def test_a_second_lidar_needs_a_first():
    with pytest.raises(ValidationError, match=r"devices\.lidar_2: expected as a second lidar"):
        with_overlay(truck(lidars(URG, LD19), 1.0), {"devices": {"lidar": None}, "gate": {"scan": {"critical": False}}})
