"""The description of a robot: a tree of links, their masses, and the files made from it."""

import math
from math import radians
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from monstertruck_kinematics.description import (
    WHEELS,
    Description,
    LidarHead,
    Mechanics,
    Part,
    PartJoint,
    SensorFrame,
    Size,
    box_inertia,
    truck_description,
    urdf,
    wheel_inertia,
)
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.platform import platform_description, rolled
from monstertruck_kinematics.unsteered import mecanum, omni


def mass_centre(robot: Description) -> np.ndarray:
    """Of all links together with all joints at zero, in the base frame, m."""
    return sum(link.mass * np.add(robot.frame(link.name), link.centre) for link in robot.links) / robot.mass


def test_the_truck_weighs_what_its_author_found():
    truck = truck_description()
    assert truck.mass == pytest.approx(7.25)
    for wheel in WHEELS:
        assert truck.link(f"{wheel}_wheel").mass + truck.link(f"{wheel}_knuckle").mass == pytest.approx(0.281)
    x, y, z = mass_centre(truck)
    assert (x, y) == pytest.approx((0.0, 0.0))
    assert 0.09 < z < 0.12


def test_its_joints_have_the_published_ranges_and_wheels_their_places():
    truck = truck_description()
    joints = {joint.name: joint for joint in truck.joints}
    assert joints["front_suspension"].limits == (-0.010, 0.030)
    assert joints["rear_roll"].limits == pytest.approx((-radians(10), radians(10)))
    assert truck.frame("front_left_wheel") == pytest.approx((0.16, 0.13, 0.075))
    assert truck.frame("rear_right_wheel") == pytest.approx((-0.16, -0.13, 0.075))


def test_its_springs_carry_it_at_zero():
    truck, parts = truck_description(), Mechanics()
    suspension = next(joint for joint in truck.joints if joint.name == "front_suspension")
    assert suspension.load == pytest.approx(-parts.sprung * 9.81 / 2)
    assert suspension.load / suspension.stiffness == pytest.approx(-0.010)


def test_a_lidar_on_joints_is_a_part_of_the_mass_and_loads_the_front_springs_more():
    head = LidarHead()
    truck = truck_description(head=head)
    assert truck.mass == pytest.approx(7.25)
    loads = {joint.name: joint.load for joint in truck.joints}
    assert loads["front_suspension"] + loads["rear_suspension"] == pytest.approx(-Mechanics().sprung * 9.81)
    moment = (loads["front_suspension"] - loads["rear_suspension"]) * 0.16
    assert moment == pytest.approx(-head.mass * 9.81 * 0.14)
    assert truck.frame("lidar_head") == (0.14, 0.0, 0.25)


def test_sensors_are_fixed_frames():
    truck = truck_description(sensors=(SensorFrame("lidar", (0.14, 0.0, 0.25)),))
    assert truck.frame("lidar") == (0.14, 0.0, 0.25)
    assert truck.link("lidar").mass == 0.0


def test_the_urdf_has_all_of_it():
    truck = truck_description(Size(wheelbase=0.4), sensors=(SensorFrame("lidar", (0.14, 0.0, 0.25), (0.0, 0.1, 0.0)),))
    robot = ET.fromstring(urdf(truck))
    assert [link.get("name") for link in robot.findall("link")] == [link.name for link in truck.links]
    mass = sum(float(element.get("value")) for element in robot.iter("mass"))
    assert mass == pytest.approx(7.25, abs=1e-4)
    by_name = {joint.get("name"): joint for joint in robot.findall("joint")}
    assert by_name["front_suspension"].find("origin").get("xyz") == "0.2 0 0.075"
    assert by_name["front_suspension"].find("limit").get("upper") == "0.03"
    assert by_name["lidar_mount"].get("type") == "fixed"
    assert by_name["lidar_mount"].find("origin").get("rpy") == "0 0.1 0"
    assert by_name["front_left_spin"].get("type") == "continuous"
    cylinder = robot.find("link[@name='front_left_knuckle']/visual/geometry/cylinder")
    assert (cylinder.get("radius"), cylinder.get("length")) == ("0.075", "0.08")


def test_moments_of_inertia():
    assert box_inertia(12.0, (1.0, 2.0, 3.0)) == (13.0, 10.0, 5.0)
    across, spin, other = wheel_inertia(1.0, 0.2, 0.0)
    assert spin == pytest.approx(0.03)
    assert across == other == pytest.approx(0.015)


@pytest.mark.parametrize(
    ("links", "joints", "text"),
    [
        ((Part("a"), Part("a")), (), "have the same name"),
        ((Part("a"), Part("b")), (), "no joint leads to"),
        ((Part("a"), Part("b")), (PartJoint("j", "fixed", "c", "b"),), "joint j: expected a parent defined before it"),
        ((Part("a"),), (PartJoint("j", "fixed", "a", "b"),), "joint j: expected a parent defined before it"),
        (
            (Part("a"), Part("b")),
            (PartJoint("i", "fixed", "a", "b"), PartJoint("j", "fixed", "a", "b")),
            "joint j: expected a parent defined before it",
        ),
    ],
)
def test_what_is_no_tree_is_refused(links, joints, text):
    with pytest.raises(KinematicsError, match=text):
        Description("robot", links, joints)


def test_masses_that_do_not_add_up_and_springs_that_do_not_hold_are_refused():
    with pytest.raises(KinematicsError, match="mass is 2"):
        Mechanics(mass=2.0)
    with pytest.raises(KinematicsError, match="roll_spring"):
        truck_description(mechanics=Mechanics(roll_spring=0.5))


def platform(count=4, **parts):
    wheels = mecanum(0.32, 0.26, 0.075).swedish if count == 4 else omni(0.15, 0.075).swedish
    return platform_description(Size(), Mechanics(**parts), wheels, (), (), LidarHead())


@pytest.mark.parametrize("count", [3, 4])
def test_a_platform_has_all_the_mass_over_its_middle(count):
    robot = platform(count)
    assert robot.mass == pytest.approx(7.25, abs=0.01)
    assert mass_centre(robot)[:2] == pytest.approx((0.0, 0.0), abs=1e-3)
    assert sum(-joint.load for joint in robot.joints) == pytest.approx((7.25 - count * 0.281) * 9.81)


def test_a_mecanum_wheel_turns_about_the_axis_of_its_rollers():
    robot = platform()
    by_name = {joint.name: joint for joint in robot.joints}
    assert by_name["front_left_suspension"].turn == pytest.approx((0.0, 0.0, -math.pi / 4))
    assert by_name["front_right_suspension"].turn == pytest.approx((0.0, 0.0, math.pi / 4))
    assert (by_name["front_left_rollers"].axis, by_name["front_left_spin"].axis) == ((1, 0, 0), (0, 1, 0))
    assert rolled(mecanum().swedish[0]) == pytest.approx(math.sqrt(0.5))
    urdf_text = urdf(robot)
    assert urdf_text.count("<sphere") == 0
    assert urdf_text.count("<cylinder") == 8  # to be seen, and to collide


def test_a_platform_that_would_fall_over_is_refused():
    with pytest.raises(KinematicsError, match="the body falls over"):
        platform(spring=50.0)
    with pytest.raises(KinematicsError, match="expected more than wheels and lidar together"):
        platform(mass=2.2, wheel_mass=0.5, axle_mass=0.05)
