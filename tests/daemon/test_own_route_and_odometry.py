"""A route planner and an odometry of another distribution, installed outside the tree, are found, checked and used."""

import json
from pathlib import Path

import pytest

from tests.plugin_kit import ROOT, installed, run_with, written

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(180)]

PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "truck-parts"
version = "1.0"
dependencies = ["monstertruckd"]

[project.entry-points."monstertruck.route_planners"]
straight = "truck_parts.plugin:STRAIGHT"

[project.entry-points."monstertruck.odometry"]
scaled = "truck_parts.plugin:SCALED"
"""
PLUGIN = '''
"""Rows of the tables."""

from monstertruck_runtime.plugins import Plugin

STRAIGHT = Plugin(
    name="straight",
    settings="truck_parts.config:StraightConfig",
    implementation="truck_parts.straight:StraightPlanner",
    doc="The straight line",
)
SCALED = Plugin(
    name="scaled",
    settings="truck_parts.config:ScaledConfig",
    implementation="truck_parts.scaled:build",
    doc="Dead reckoning with wheels of another size",
)
'''
CONFIG = '''
"""Settings."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_estimation.odometry import OdometrySettings
from monstertruck_planners.route.config import GoalConfig
from monstertruck_schemas.base import Pose2D


class StraightConfig(GoalConfig):
    kind: Literal["straight"]
    spacing: Annotated[float, Field(gt=0)] = 0.1


class ScaledConfig(OdometrySettings):
    kind: Literal["scaled"]
    start: Pose2D
    scale: Annotated[float, Field(gt=0)] = 1.0
'''
STRAIGHT = '''
"""A line of poses from start to goal."""

import numpy as np

from monstertruck_planners.route.api import RouteResult
from monstertruck_schemas.reasons import Reason


class StraightPlanner:
    def __init__(self, vehicle, config):
        self.vehicle = vehicle
        self.config = config

    def plan(self, route_map, start, goal, now=None):
        start, goal = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
        length = float(np.hypot(*(goal - start)[:2]))
        steps = np.linspace(0.0, 1.0, int(np.ceil(length / self.config.spacing)) + 1)[:, None]
        return RouteResult(Reason.OK, poses=start + steps * (goal - start), cost=length)
'''
SCALED = '''
"""The drive's motion times a factor."""

from monstertruck_estimation.odometry import DeadReckoning, OdometryConfig, OdometryService


class Scaled(DeadReckoning):
    def __init__(self, config, chassis):
        super().__init__(OdometryConfig(start=config.start), chassis)
        self._scale = config.scale

    def observe_drive(self, *shafts):
        super().observe_drive(*(s.model_copy(update={"position": s.position * self._scale}) for s in shafts))


def build(config, context):
    return OdometryService(Scaled(config, context.chassis), context.clock, rate=config.rate, **context.inputs())
'''
FILES = {
    "pyproject.toml": PROJECT,
    "truck_parts/__init__.py": "",
    "truck_parts/plugin.py": PLUGIN,
    "truck_parts/config.py": CONFIG,
    "truck_parts/straight.py": STRAIGHT,
    "truck_parts/scaled.py": SCALED,
}


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the wheel is installed."""
    project = written(FILES, tmp_path_factory.mktemp("parts"))
    return installed(project, project / "site")


def test_they_are_listed_with_their_origin(target: Path):
    rows = {row["name"]: row for row in json.loads(run_with(target, "plugins", "--json"))}
    for name in ("straight", "scaled"):
        assert (rows[name]["origin"], rows[name]["error"]) == ("truck-parts 1.0", None)


def test_the_route_planner_plans_and_is_a_choice_of_the_daemon(target: Path, tmp_path: Path):
    rooms = str(ROOT / "configs" / "worlds" / "rooms.yaml")
    report = json.loads(
        run_with(target, "plan", rooms, "1,3.95,0", "3,3.95,0", "-p", "straight", "--reproducible", "--json")
    )
    assert report["reason"] == "ok"
    config = tmp_path / "robot.yaml"
    text = f"include: {ROOT}/configs/goals.yaml\nversion: 2\nplanner:\n  route: {{ kind: straight, spacing: 0.2 }}\n"
    config.write_text(text)
    assert "planner.route.spacing" in run_with(target, "config", "show", str(config))
    config.write_text(text.replace("spacing", "spaceing"))
    with pytest.raises(
        AssertionError, match=r"robot\.yaml:4: planner\.route\.spaceing: unknown key \(did you mean spacing\?\)"
    ):
        run_with(target, "config", "show", str(config))


@pytest.mark.long
def test_the_odometry_drives_the_lap_and_its_settings_count(target: Path, tmp_path: Path):
    config = tmp_path / "robot.yaml"
    config.write_text(
        f"include: {ROOT}/configs/demo.yaml\nversion: 2\nodometry: {{ kind: scaled, scale: 0.97 }}\n"
        "path: { file: short.csv, closed: false }\n"
    )
    points = (f"{0.05 * i:.3f},-1.7,0.0,1" for i in range(31))
    (tmp_path / "short.csv").write_text("\n".join(["x,y,yaw,direction", *points, ""]))
    folder = tmp_path / "run"
    out = run_with(target, "demo", "--fast", "-c", str(config), "-o", str(folder), "--json")
    figures = json.loads(out)
    assert figures["outcome"] == "goal_reached"
    assert 1.53 < figures["distance_m"] < 1.57, "wheels thought 3 % smaller drive 3 % further"
