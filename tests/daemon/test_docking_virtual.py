"""Docking in the whole daemon: images of the camera, the gate, contacts of the charger, and the mission around it."""

import json
import math
from pathlib import Path

import pytest

from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.runs import run_mission
from tests.daemon.goal_kit import Trip, travel
from tests.daemon.test_missions_virtual import MissionOperator

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(900)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
DOCK = {"x": 2.5, "y": 0.805, "yaw": -math.pi / 2}


def docked(start: tuple[float, float, float], steps: list[dict], dock: dict | None = None):
    """Do steps in ``configs/dock.yaml``; returns the end, the reports of the gate and the truth."""
    pose = dict(zip(("x", "y", "yaw"), start, strict=True))
    mission = Mission.model_validate_json(json.dumps({"version": 2, "name": "dock", "steps": steps}))
    ends, gate = [], []

    async def story(trip: Trip) -> None:
        with trip.rig.bus.subscribe(topics.GATE, fifo(65536)) as states:
            ends.append(await run_mission(MissionOperator(trip.rig.daemon, trip.clock), mission, arm=True))
            gate.extend(states.drain())
        await trip.clock.sleep(1.0)

    overlay = {
        "odometry": {"start": pose},
        "devices": {"camera": {"driver": {"rate": 5}}},
        "sim": {"world": {"start": pose, **({} if dock is None else {"chargers": [DOCK | dock]})}},
    }
    if dock is not None:
        overlay["docks"] = {"charger": {"direction": "reverse", **dock}}
    truth = travel(story, "dock.yaml", **overlay).truth.array()
    return ends[0], gate, truth


def off(pose, dock: dict) -> tuple[float, float]:
    """Distance (m) and heading (degrees) from the docked pose."""
    turn = math.degrees(abs(math.remainder(float(pose[2]) - dock["yaw"], math.tau)))
    return math.dist(pose[:2], (dock["x"], dock["y"])), turn


def test_the_truck_docks_and_charges_slowly():
    end, gate, truth = docked((2.53, 1.6, -1.6), [{"do": "dock"}])
    assert end.reason is Reason.MISSION_DONE, end.text
    assert not truth[:, 5].any(), "collided"
    distance, turn = off(truth[-1, 1:4], DOCK)
    assert distance < 0.01
    assert turn < 1.0
    assert any(Reason.DOCKING in state.reasons for state in gate)
    assert not (CONFIGS / "worlds" / "saves").exists(), "the dock's tag is saved beside a map of several robots"


@pytest.mark.long
def test_the_truck_turns_its_rear_to_the_dock():
    dock = {"yaw": math.pi / 2}
    end, _, truth = docked((2.5, 1.6, -1.57), [{"do": "dock"}, {"do": "wait", "seconds": 1.0}], dock)
    assert end.reason is Reason.MISSION_DONE, end.text
    assert not truth[:, 5].any(), "collided"
    distance, turn = off(truth[-1, 1:4], DOCK | dock)
    assert distance < 0.01
    assert turn < 1.0


def test_it_leaves_the_dock_slowly():
    end, gate, truth = docked((2.5, 0.805, -math.pi / 2), [{"do": "undock"}])
    assert end.reason is Reason.MISSION_DONE, end.text
    assert not truth[:, 5].any(), "collided"
    assert math.dist(truth[-1, 1:3], (DOCK["x"], DOCK["y"] + 0.7)) < 0.05, "not at the staging pose"
    assert any(Reason.DOCKING in state.reasons for state in gate)
