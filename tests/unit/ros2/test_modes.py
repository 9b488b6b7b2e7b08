"""Configurations in which ROS 2 plans, localises or maps."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.station.frames import facts
from monstertruckd.tools.cli.ros2 import robot_facts

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def changed(name="goals", **sections):
    """A configuration with other settings in some sections; None removes one."""
    values = load_truck(CONFIGS / f"{name}.yaml")[0].model_dump()
    for section, settings in sections.items():
        values[section] = settings if settings is None else (values[section] or {}) | settings
    return TruckConfig.model_validate(values)


def test_a_robot_plans_localises_and_maps_by_itself_unless_configured_otherwise():
    config = changed()
    found = robot_facts(config)
    assert config.own_planner is config.planner is not None
    assert (found.plans, found.localised, found.mapped) == (True, True, True)
    assert '"goals":true' in facts(config.model_dump(mode="json"), {})


def test_nav2_as_planner_needs_a_source_that_may_drive():
    ros2 = {"planner": {"mode": "ros2"}, "explorer": None}
    with pytest.raises(ValidationError, match=r"planner.mode ros2 needs gate.remote_trackers"):
        changed(**ros2)
    config = changed(**ros2, gate={"remote_trackers": ("ros2:velocity_smoother",)}, tracker=None)
    assert config.own_planner is None
    assert not robot_facts(config).plans
    assert '"goals":false' in facts(config.model_dump(mode="json"), {})


def test_a_planner_with_slam_by_ros_2_plans_in_the_map_of_ros_2_or_its_own():
    slam, rooms = {"mode": "ros2"}, CONFIGS / "worlds" / "rooms.yaml"
    found = robot_facts(changed("slam", slam=slam, planner={"map": None}))
    assert (found.plans, found.localised, found.mapped) == (True, False, False)
    found = robot_facts(changed("slam", slam=slam, planner={"map": rooms}))
    assert (found.plans, found.localised, found.mapped) == (True, False, True)
