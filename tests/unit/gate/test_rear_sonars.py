"""Sonars that look backwards show a robot with a lidar the ground behind it, as long as they answer."""

import math

import numpy as np
import pytest

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarEcho, SonarRanges
from monstertruckd.gate.rear_sonars import rear
from monstertruckd.gate.scan_memory import MAP_CELL, MAP_SIZE
from tests.unit.gate.rig import Rig, header, show
from tests.unit.gate.test_scan_memory import BACK

MOUNTS = {"rl": (0.0, 0.1, math.pi), "rr": (0.0, -0.1, math.pi)}
"""Their cones cover the whole width of the body at its tail."""
WALL = 1.2
"""Distance of a wall behind the place where the robot begins, m."""


class SonarRig(Rig):
    """A truck before a wall behind it, which its sonars measure, except those that are dead."""

    def __init__(self, mounts=MOUNTS, **config):
        super().__init__(rear_sonars=mounts, **config)
        self.mounts = mounts
        self.x = 0.0
        self.heard = {}
        """Range by name, m; None = no echo."""
        self.dead = set()
        self.age = 0
        """Ns."""

    def sense(self):
        super().sense()
        if "sonar" not in self.silent:
            echoes = tuple(
                SonarEcho(
                    name=name,
                    answered=name not in self.dead,
                    range=self.heard.get(name, max(WALL + self.x + place[0], 0.15)),
                    stamp=self.now,
                )
                for name, place in self.mounts.items()
            )
            fields = {**header(self.now), "stamp": self.now - self.age}
            show(self.gate, SonarRanges(sonars=echoes, field_of_view=0.87, range_min=0.15, range_max=3.0, **fields))

    def _obey(self):
        super()._obey()
        self.x += self.speed * 0.02

    @property
    def room(self):
        """Distance between tail and wall, m."""
        return WALL + self.x - BACK


def test_it_reverses_at_once_onto_ground_that_its_sonars_see_and_stops_before_what_they_measure():
    rig = SonarRig().driving(speed=-0.15)
    assert rig.out.reasons == ()
    assert rig.out.speeds[0] == pytest.approx(-0.15)
    rig.tick(600)
    assert rig.out.speeds[0] == 0.0
    assert 0.05 < rig.room < 0.15
    rig.driver = {"speed": -0.15, "unseen": True}
    rig.tick(200)
    assert Reason.OBSTACLE_STOP in rig.out.reasons, "the second control is for ground where nothing was measured"
    assert rig.room > 0.03


@pytest.mark.parametrize(
    "without",
    [
        lambda rig: rig.silent.add("sonar"),
        lambda rig: rig.dead.update(MOUNTS),
        lambda rig: rig.dead.add("rl"),
        lambda rig: rig.heard.update(rl=None, rr=None),
        lambda rig: rig.heard.update(rl=0.15, rr=0.15),
        lambda rig: setattr(rig, "age", 900_000_000),
    ],
    ids=["silent", "dead", "one dead", "no echo", "nearer than measured", "late"],
)
def test_sonars_that_show_no_ground_lift_no_limit(without):
    rig = SonarRig()
    without(rig)
    rig.driving(speed=-0.15)
    assert Reason.UNSEEN_STOP in rig.out.reasons
    assert rig.x == 0.0


@pytest.mark.parametrize("loss", [lambda rig: rig.silent.add("sonar"), lambda rig: rig.dead.update(MOUNTS)])
def test_a_sonar_that_falls_silent_shows_nothing_any_more(loss):
    rig = SonarRig().driving(speed=-0.15)
    loss(rig)
    rig.tick(14)
    assert rig.out.reasons == ()
    rig.tick(2)
    assert Reason.UNSEEN_STOP in rig.out.reasons
    rig.silent, rig.dead = set(), set()
    rig.tick(40)
    assert rig.out.speeds[0] == pytest.approx(-0.15)


def test_somebody_who_steps_behind_it_stops_it_although_the_ground_was_free():
    rig = SonarRig().driving(speed=-0.15)
    rig.heard = {"rl": BACK + 0.1}
    rig.tick(40)
    assert Reason.OBSTACLE_STOP in rig.out.reasons
    assert rig.out.speeds[0] == 0.0
    rig.driver = {"speed": 0.15}
    rig.tick(40)
    assert rig.out.speeds[0] == pytest.approx(0.15)


def test_its_corners_may_cover_what_a_single_cone_saw_from_further_away():
    rig = SonarRig({"r": (-BACK, 0.0, math.pi)}, disarm_after=10.0).driving(ticks=160, speed=0.2)
    rig.driver = {"speed": -0.15}
    rig.tick(800)
    assert rig.x < -0.4, "beyond the place where it began"
    assert 0.05 < rig.room < 0.3


def result(steps):
    """What a generator returns."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def test_what_the_sonars_see_is_in_the_survey():
    for mounts, seen in ((MOUNTS, True), ({}, False)):
        rig = SonarRig(mounts).armed()
        ages = result(rig.gate.survey()).ages
        row, column = MAP_SIZE // 2, MAP_SIZE // 2 - round((BACK + 0.4) / MAP_CELL)
        assert bool(ages[row, column] >= 0) is seen
        assert ages[row, MAP_SIZE // 2 - round((WALL + 0.1) / MAP_CELL)] == -1


def test_an_answer_of_a_sonar_that_looks_elsewhere_says_nothing_of_the_ground_behind():
    rig = SonarRig().armed()
    rig.mounts = {"f": (0.2, 0.0, 0.0), **MOUNTS}
    rig.heard["f"] = 0.2
    rig.driver = {"speed": -0.15}
    rig.tick(600)
    assert 0.05 < rig.room < 0.15


def test_only_those_count_that_look_backwards():
    mounts = {name: (0.0, 0.0, yaw) for name, yaw in zip("abcd", np.radians([180, -165, 135, 0]), strict=True)}
    assert set(rear(mounts)) == {"a", "b"}
