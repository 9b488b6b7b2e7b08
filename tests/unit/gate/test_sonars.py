"""The footprint against the arcs of sonars: walls beside, walls ahead, sonars that say nothing."""

from math import cos, inf, pi

import pytest

from monstertruck_kinematics.chassis import STILL
from monstertruck_planners.collision import Footprint
from monstertruck_schemas.sensor import SonarEcho, SonarRanges
from monstertruck_sim.world.config import FIVE_SONARS
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.motion import Motion
from monstertruckd.gate.sonars import SonarGuard
from tests.unit.gate.rig import CHASSIS

MS = 1_000_000
FORWARD, BACK, SPOT = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 7.4)
MOUNTS = {name: (place.x, place.y, place.yaw) for name, place in FIVE_SONARS.items()}
BODY = Footprint(0.32, 0.30)


def guard(now=1000 * MS, dead=(), **ranges):
    made = SonarGuard(InForce(GateConfig()), BODY, MOUNTS)
    for _ in range(2):
        made.observe(rounds(now, dead, **ranges))
    return made


def rounds(now, dead=(), late=0, **ranges):
    sonars = tuple(SonarEcho(name=n, answered=n not in dead, range=ranges.get(n), stamp=now) for n in MOUNTS)
    return SonarRanges(
        stamp=now - late, received=now, seq=0, sonars=sonars, field_of_view=0.87, range_min=0.15, range_max=3.0
    )


@pytest.mark.parametrize("fl", [0.3 / cos(pi / 4), 0.3 / cos(pi / 4 - 0.435)], ids=["beam", "cone"])
def test_a_wall_beside_the_robot_is_not_in_its_way(fl):
    view = guard(l=0.30, fl=fl).look(FORWARD, 0.6, 1000 * MS)
    assert view == (inf, (), False)


def test_a_turn_on_the_spot_before_a_wall_is_free():
    assert guard(f=0.29, fl=0.33, fr=0.33).look(SPOT, 0.5, 1000 * MS) == (inf, (), False)


def test_a_wall_ahead_ends_the_way_wherever_on_its_arc_it_is():
    view = guard(f=0.4).look(FORWARD, 0.6, 1000 * MS)
    assert view.free == pytest.approx(0.12 + 0.4 - 0.16 - 0.06, abs=0.06)
    assert view.free <= 0.12 + 0.4 - 0.16


def test_a_corner_of_the_robot_does_not_turn_into_a_wall():
    assert guard(fl=0.16).look((0.3, 0.0, 6.0), 0.4, 1000 * MS).free < 0.2


@pytest.mark.parametrize(
    ("way", "dead", "seen"),
    [
        (FORWARD, ("f",), (("f",), False)),
        (FORWARD, ("r",), ((), True)),
        (SPOT, ("f",), ((), True)),
        (BACK, (), ((), True)),
    ],
)
def test_sonars_that_do_not_answer(way, dead, seen):
    assert guard(dead=dead).look(way, 0.5, 1000 * MS)[1:] == seen


def test_one_missed_answer_is_no_loss_and_one_missed_echo_frees_no_way():
    made = guard(f=0.3)
    made.observe(rounds(1100 * MS, dead=("f",)))
    view = made.look(FORWARD, 0.6, 1100 * MS)
    assert view.dead == ()
    assert view.free < 0.3


def test_what_is_late_or_old_does_not_count():
    made = SonarGuard(InForce(GateConfig()), BODY, MOUNTS)
    made.observe(rounds(1000 * MS, late=900 * MS))
    assert not made.fresh(1000 * MS)
    assert guard().fresh(1290 * MS)
    assert not guard().fresh(1310 * MS)


def test_the_yaw_rate_grows_within_its_limit():
    motion = Motion(InForce(GateConfig(yaw_acceleration=0.5)), CHASSIS)
    motion.steer((0.4, -0.4), 10.0)
    target = motion.along((0.2, 0.0, 0.5))
    before = STILL
    for _ in range(20):
        motion.accelerate(target, 0.02)
        assert motion.twist[2] - before[2] <= 0.5 * 0.02 + 1e-9
        before = motion.twist
    assert before[2] > 0.1
