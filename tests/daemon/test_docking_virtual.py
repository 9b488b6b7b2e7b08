"""Docking in the whole daemon: images of the camera, the gate, contacts of the charger, and the mission around it."""

import json
import math
from pathlib import Path

import pytest

from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import MissionOrder
from monstertruckd.station.pilot import read_mission
from monstertruckd.tools.cli.mission import load
from monstertruckd.tools.cli.runs import run_mission
from tests.daemon.goal_kit import Trip, travel
from tests.daemon.test_missions_virtual import MissionOperator

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(900)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
DOCK = {"x": 2.5, "y": 0.805, "yaw": -math.pi / 2}


def overlay(start: tuple[float, float, float], dock: dict | None = None, **more) -> dict:
    """Changes of ``configs/dock.yaml``: where the truck starts, and a dock in reverse."""
    pose = dict(zip(("x", "y", "yaw"), start, strict=True))
    changes = {
        "odometry": {"start": pose},
        "devices": {"camera": {"driver": {"rate": 5}}},
        "sim": {"world": {"start": pose, **({} if dock is None else {"chargers": [DOCK | dock]}), **more}},
    }
    return changes if dock is None else changes | {"docks": {"charger": {"direction": "reverse", **dock}}}


def docked(start: tuple[float, float, float], steps: list[dict], dock: dict | None = None, **changes):
    """Do steps as the page's buttons send them in ``configs/dock.yaml``; returns end, gate's reports and truth."""
    mission = read_mission(json.dumps({"version": 2, "name": "dock", "steps": steps}))
    ends, gate = [], []

    async def story(trip: Trip) -> None:
        with trip.rig.bus.subscribe(topics.GATE, fifo(65536)) as states:
            ends.append(await run_mission(MissionOperator(trip.rig.daemon, trip.clock), mission, arm=True))
            gate.extend(states.drain())
        await trip.clock.sleep(1.0)

    truth = travel(story, "dock.yaml", **overlay(start, dock), **changes).truth.array()
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
@pytest.mark.parametrize("slam", [None, {"mode": "mapping"}], ids=["by odometry", "by scans"])
def test_the_truck_turns_its_rear_to_the_dock(slam: dict | None):
    dock, changes = {"yaw": math.pi / 2}, {} if slam is None else {"slam": slam}
    end, _, truth = docked((2.5, 1.6, -1.57), [{"do": "dock"}, {"do": "wait", "seconds": 1.0}], dock, **changes)
    assert end.reason is Reason.MISSION_DONE, end.text
    assert not truth[:, 5].any(), "collided"
    distance, turn = off(truth[-1, 1:4], DOCK | dock)
    assert distance < 0.01
    assert turn < 1.0


@pytest.mark.long
def test_it_leaves_the_dock_slowly():
    end, gate, truth = docked((2.5, 0.805, -math.pi / 2), [{"do": "undock", "dock": "charger"}])
    assert end.reason is Reason.MISSION_DONE, end.text
    assert not truth[:, 5].any(), "collided"
    assert math.dist(truth[-1, 1:3], (DOCK["x"], DOCK["y"] + 0.7)) < 0.05, "not at the staging pose"
    assert any(Reason.DOCKING in state.reasons for state in gate)


@pytest.mark.long
def test_below_20_percent_it_docks_charges_undocks_and_resumes_its_rounds():
    """The shipped mission; the hours of charging are a new pack."""
    mission, seen = load(CONFIGS / "missions" / "charge.yaml"), []

    async def story(trip: Trip) -> None:
        operator = MissionOperator(trip.rig.daemon, trip.clock)
        with trip.rig.bus.subscribe(topics.MISSION, fifo(4096)) as states:
            await operator.arm()
            await operator.mission(MissionOrder.START, mission)
            async with trip.clock.deadline(400.0):
                while not (len(seen) > 3 and seen[-1].startswith("goto")):
                    state = await states.next()
                    assert not state.number or state.running, state.text
                    if state.doing and seen[-1:] != [state.doing]:
                        seen.append(state.doing)
                    if state.doing.startswith("wait"):
                        trip.rig.world.set_charge(trip.rig.clock.now(), 0.85)

    rig = travel(story, "dock.yaml", **overlay((2.53, 1.6, -1.6), battery={"charge": 0.12}))
    assert not rig.truth.array()[:, 5].any(), "collided"
    assert [text.split()[0] for text in seen][-4:] == ["dock", "wait", "undock", "goto"]
