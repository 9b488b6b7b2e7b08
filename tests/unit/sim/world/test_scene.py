"""Several robots and people in one world: they see each other, run into each other, and every run of a seed is one."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import PersonConfig, Spot, WorldConfig
from monstertruck_sim.world.obstacles import Disc
from monstertruck_sim.world.scene import Contact
from monstertruck_sim.world.world import World, make_scene

SECOND = 1_000_000_000
RPM_PER_SPEED = 644 / (2 * np.pi * 0.075) * 60
AHEAD = 384
"""Step of the lidar that looks ahead."""


def worlds(*starts: tuple[float, float, float], people: tuple[PersonConfig, ...] = (), seed: int = 1) -> list[World]:
    configs = [
        WorldConfig(map="yard", noise=False, start=Pose2D(x=x, y=y, yaw=yaw), people=people) for x, y, yaw in starts
    ]
    scene = make_scene(configs[0], seed)
    return [World(config, seed, scene, f"robot_{i}") for i, config in enumerate(configs)]


def drive(world: World, now: int, speed: float) -> None:
    world.motors[0].command(now, -speed * RPM_PER_SPEED, 20_000.0)


def walk(*points: tuple[float, float], **habits: object) -> PersonConfig:
    return PersonConfig(waypoints=tuple(Spot(x=x, y=y) for x, y in points), **habits)


def run(world: World, seconds: float, start: int = 0) -> int:
    for now in range(start, start + round(seconds * SECOND), SECOND // 20):
        world.truth(now)
    return start + round(seconds * SECOND)


def test_a_lidar_sees_the_outline_of_another_robot():
    first, _ = worlds((0.0, 0.0, 0.0), (2.0, 0.0, math.pi / 2))
    first.truth(0)
    assert first.lidar.scan(0)[AHEAD] == pytest.approx((2.0 - 0.14 - 0.34 / 2) * 1000, abs=2)


def test_a_lidar_sees_a_moving_robot_where_it_was_at_each_beams_instant():
    """A robot that crosses the view during the sweep is met at its edges' places then, not at one instant's."""
    first, second = worlds((0.0, 0.0, 0.0), (1.5, -1.5, math.pi / 2))
    first.truth(0)
    drive(second, 0, 0.2)
    start = run(second, 8.0)
    second.truth(start + SECOND // 10)
    ranges = first.lidar.scan(start)
    seen = np.flatnonzero((ranges > 900) & (ranges < 1600))
    at = second._plant.poses(np.array([start + int(seen[-1]) * (SECOND // 10 // 1024)]))[1, 0]
    angle = (seen[-1] - 384) * math.tau / 1024
    nose = (1.5 - 0.14 - 0.17) * math.tan(angle)
    assert nose == pytest.approx(at + 0.47 / 2, abs=0.012)


def test_robots_that_run_into_each_other_stop_and_are_reported_once():
    first, second = worlds((0.0, 0.0, 0.0), (0.8, 0.0, math.pi))
    first.truth(0)
    drive(first, 0, 0.1)
    end = run(second, 6.0)
    a, b = first.truth(end), second.truth(end)
    assert b.x == pytest.approx(0.8)
    assert a.x == pytest.approx(0.8 - 0.47, abs=0.002)
    assert a.stuck
    assert not b.stuck
    (contact,) = first.scene.contacts
    assert (contact.mover, contact.other, contact.other_speed) == ("robot_0", "robot_1", 0.0)
    assert contact.speed == pytest.approx(0.1, abs=0.01)
    assert str(contact) == "contact: robot_0 at 0.10 m/s with robot_1 at 0.00 m/s"


def test_a_second_touch_after_parting_is_another_contact():
    first, _ = worlds((0.0, 0.0, 0.0), (0.8, 0.0, math.pi))
    first.truth(0)
    drive(first, 0, 0.1)
    now = run(first, 5.0)
    drive(first, now, -0.1)
    now = run(first, 4.0, now)
    drive(first, now, 0.1)
    run(first, 6.0, now)
    assert len(first.scene.contacts) == 2


def test_both_drive_into_each_other_and_neither_gets_inside():
    first, second = worlds((0.0, 0.05, 0.0), (1.2, -0.05, math.pi))
    first.truth(0)
    drive(first, 0, 0.15)
    drive(second, 0, 0.15)
    end = run(first, 8.0)
    assert second.truth(end).x - first.truth(end).x == pytest.approx(0.47, abs=0.004)


def test_an_obstacle_of_one_is_an_obstacle_of_all():
    first, second = worlds((0.0, 0.0, 0.0), (0.0, 1.5, 0.0))
    first.truth(0)
    first.add(0, Disc(1.0, 1.5, 0.1))
    assert second.lidar.scan(0)[AHEAD] == pytest.approx((1.0 - 0.14 - 0.1) * 1000, abs=2)
    drive(second, 0, 0.2)
    assert second.truth(run(second, 8.0)).stuck


@pytest.mark.parametrize(
    ("starts", "people", "said"),
    [
        (((0.0, 0.0, 0.0), (0.3, 0.1, 1.0)), (), "robots robot_0 and robot_1 overlap"),
        (((0.0, 0.0, 0.0),), (walk((0.1, 0.0), (2.0, 0.0)),), "robot robot_0 and person 1 overlap"),
        (((0.0, 0.0, 0.0),), (walk((1.0, 0.0), (9.0, 0.0)),), r"sim.world.people.0: the path from .* touches occupied"),
    ],
)
def test_who_stands_in_each_other_is_refused(starts, people, said):
    with pytest.raises(InputError, match=said):
        worlds(*starts, people=people)


def test_a_robot_of_the_same_name_is_refused():
    config = WorldConfig(map="yard")
    scene = make_scene(config, 1)
    World(config, 1, scene, "same")
    with pytest.raises(InputError, match="robot same: two robots of this name"):
        World(config.model_copy(update={"start": Pose2D(x=2.0, y=0.0, yaw=0.0)}), 1, scene, "same")


def test_a_person_needs_two_way_points_or_none():
    with pytest.raises(ValueError, match="two or more"):
        walk((0.0, 0.0))


# People


def places(world: World, seconds: float) -> Array:
    """Of all people, 20 times a second: (n, people, 2)."""
    rows = []
    for now in range(0, round(seconds * SECOND), SECOND // 20):
        world.truth(now)
        rows.append([(person.x, person.y) for person in world.scene.people])
    return np.array(rows)


def test_a_person_walks_to_its_way_points_and_is_seen_where_it_is():
    (world,) = worlds((-2.0, 0.0, 0.0), people=(walk((1.0, -1.0), (1.0, 1.0), pause=0.0, speed=0.5),))
    track = places(world, 20.0)[:, 0]
    assert np.allclose(track[:, 0], 1.0)
    assert track[:, 1].min() == pytest.approx(-1.0, abs=0.06)
    assert track[:, 1].max() == pytest.approx(1.0, abs=0.06)
    steps = np.abs(np.diff(track[:, 1]))
    assert 0.5 * 0.8 / 20 - 0.011 < np.median(steps) < 0.5 * 1.2 / 20 + 0.011
    person = world.scene.people[0]
    now = 20 * SECOND
    world.truth(now)
    angle = math.atan2(person.y, person.x + 2.0 - 0.14)
    scan = world.lidar.scan(now - SECOND // 10)
    distance = math.hypot(person.y, person.x + 2.0 - 0.14) - 0.2
    assert scan[384 + round(angle * 1024 / math.tau)] == pytest.approx(distance * 1000, abs=30)


def test_people_are_drawn_by_the_seed_alone():
    people = (PersonConfig(), PersonConfig(before="turn"))

    def seen(seed: int) -> Array:
        return places(worlds((0.0, 0.0, 0.0), people=people, seed=seed)[0], 15.0)

    assert np.array_equal(seen(3), seen(3))
    assert not np.array_equal(seen(3), seen(4))


@pytest.mark.parametrize(("before", "passes"), [("stop", False), ("turn", True)])
def test_before_a_standing_robot_a_person_stops_or_turns_aside(before, passes):
    person = walk((2.0, 0.02), (-2.0, 0.02), before=before, pause=0.0)
    (world,) = worlds((0.0, 0.0, 0.0), people=(person,))
    track = places(world, 16.0)[:, 0]
    assert not world.scene.contacts
    assert (track[:, 0].min() < -1.0) == passes
    apart = np.hypot(np.maximum(abs(track[:, 0]) - 0.235, 0), np.maximum(abs(track[:, 1]) - 0.17, 0)) - 0.2
    assert apart.min() > (0.02 if passes else 0.5)


def test_a_person_that_walks_on_touches_the_robot_and_does_not_push_it():
    (world,) = worlds((0.0, 0.0, 0.0), people=(walk((2.0, 0.0), (-2.0, 0.0), before="walk_on", pause=0.0),))
    places(world, 6.0)
    (contact,) = world.scene.contacts
    assert isinstance(contact, Contact)
    assert (contact.mover, contact.other, contact.other_speed) == ("person 1", "robot_0", 0.0)
    assert world.truth(6 * SECOND).x == 0.0


def test_a_robot_that_drives_into_a_person_is_stopped_and_reported():
    (world,) = worlds((0.0, 0.0, 0.0), people=(walk((1.0, 0.0), (1.0, 0.5), pause=1000.0),))
    world.truth(0)
    drive(world, 0, 0.2)
    end = run(world, 8.0)
    assert world.truth(end).stuck
    assert [contact.mover for contact in world.scene.contacts][:1] == ["robot_0"]


def test_a_world_without_others_is_as_before():
    """Nothing else moves: the robot is integrated at the instants that are asked for, as ever."""
    (alone,) = worlds((0.0, 0.0, 0.0))
    other = World(WorldConfig(map="yard", noise=False, start=Pose2D(x=0.0, y=0.0, yaw=0.0)), 1)
    for world in (alone, other):
        world.truth(0)
        drive(world, 0, 0.2)
    assert alone.truth(3 * SECOND) == other.truth(3 * SECOND)
