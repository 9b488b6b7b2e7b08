"""A lidar at each end: what either sees guards the body."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.topics import SCAN, SCAN_2
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.obstacles import ObstacleGuard
from monstertruckd.gate.samples import Samples
from tests.unit.gate.rig import CHASSIS, SERVICES, TICK, scan

FOOTPRINT = Footprint()
FRONT, REAR = (0.14, 0.0, 0.0), (-0.14, 0.0, math.pi)
BACK, AHEAD = (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)


def guarding():
    return ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(FRONT), ScanPoints(REAR)])


def behind(now, *obstacles, **more):
    """A scan of the rear lidar, which is the front one turned by pi about base; obstacles in base."""
    return scan(now, *((-x, -y) for x, y in obstacles), **more)


def test_in_reverse_it_drives_to_what_the_rear_lidar_sees():
    guard = guarding()
    guard.observe(scan(SECOND))
    guard.free_distance((BACK,))
    assert guard.known < 0.1, "nobody has seen the ground behind yet"
    guard.observe(behind(SECOND, (-0.5, 0.0)), 1)
    assert guard.free_distance((BACK,)) == pytest.approx(0.5 - FOOTPRINT.half_length - 0.02, abs=0.02)
    assert guard.known == math.inf
    assert guard.unseen == 0.0
    assert guard.free_distance((AHEAD,)) == math.inf


@pytest.mark.parametrize("older", [0, 1])
def test_what_the_older_scan_shows_stays_in_its_place_while_the_body_moves(older):
    guard, now = guarding(), SECOND
    post = (-0.45, 0.0) if older else (0.45, 0.0)
    shown = [scan(now), behind(now)]
    shown[older] = behind(now, post) if older else scan(now, post)
    for lidar, message in enumerate(shown):
        guard.observe(message, lidar)
    for _ in range(25):
        now += TICK
        guard.move(now, (0.2, 0.0, 0.0), 0.02)
    guard.observe(scan(now) if older else behind(now), 1 - older)
    free = guard.free_distance((BACK if older else AHEAD,))
    moved = 0.1 if older else -0.1
    assert free == pytest.approx(0.45 + moved - FOOTPRINT.half_length - 0.02, abs=0.02)
    assert guard.delay(now) >= (now - SECOND) / SECOND, "as old as the older scan"


def test_where_one_lidar_is_covered_the_other_one_sees():
    guard = guarding()
    covered = ((-120, -60, 3), (60, 120, 3))
    all_around = {"start_angle": -math.pi, "end_angle": math.pi}
    guard.observe(scan(SECOND, unknown=covered))
    guard.observe(behind(SECOND).model_copy(update=all_around), 1)
    guard.free_distance(((0.0, 1.0, 0.0), (0.0, -1.0, 0.0)))
    assert guard.unseen == 0.0
    guard.observe(behind(SECOND + TICK, unknown=((-120, 120, 3),)).model_copy(update=all_around), 1)
    guard.free_distance((BACK,))
    assert guard.unseen == pytest.approx(TICK / SECOND)


def test_points_that_one_lidar_has_lost_are_remembered_only_where_none_looks():
    guard, now = guarding(), SECOND
    guard.observe(scan(now, (0.0, 0.4)))
    guard.observe(behind(now), 1)
    assert len(guard.memory.points()) == 0
    for _ in range(100):
        now += TICK
        guard.move(now, (0.2, 0.0, 0.0), 0.02)
    guard.observe(scan(now))
    guard.observe(behind(now), 1)
    assert len(guard.memory.points()) == 0, "the rear one looks there now, and nothing is there"


def test_the_silence_of_either_is_stale_and_named():
    samples = Samples(InForce(GateConfig()), CHASSIS, {**SERVICES, "lidar_2": Reason.SCAN_STALE}, 2)
    samples.observe(scan(SECOND), SCAN)
    assert samples.staleness(Reason.SCAN_STALE, SECOND).source is DeviceRole.LIDAR_2
    samples.observe(scan(SECOND), SCAN_2)
    assert samples.scan_fresh(SECOND)
    later = SECOND + round(0.3 * SECOND)
    samples.observe(scan(later), SCAN_2)
    assert not samples.scan_fresh(later)
    assert samples.staleness(Reason.SCAN_STALE, later).source is DeviceRole.LIDAR
    samples.observe(scan(later).model_copy(update={"tilt": 1.0}), SCAN)
    assert samples.staleness(Reason.SCAN_STALE, later).refused.name == "scan plane tilt"
    samples.observe(scan(later), SCAN)
    assert samples.scan_fresh(later)


def test_the_ground_that_both_see_is_seen():
    guard = guarding()
    guard.observe(scan(SECOND))
    guard.observe(behind(SECOND), 1)
    ground = np.column_stack((np.linspace(-1.0, 1.0, 21), np.zeros(21)))
    assert guard.memory.seen(ground).all()
