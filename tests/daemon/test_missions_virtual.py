"""A mission in the whole daemon: goals, a move, a note, and the way back."""

import json
from pathlib import Path

import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.runs import run_mission
from monstertruckd.tools.simulation.operator import LocalOperator
from tests.daemon.goal_kit import Trip, assert_at, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


class MissionOperator(LocalOperator):
    """Gives orders about missions as ``TruckClient`` does."""

    async def mission(self, order, mission=None, *, moved=False, own=False):
        steps = None if mission is None else mission.model_dump(mode="json")
        wanted = {"order": order, "mission": steps, "moved": moved, "own": own}
        return await self.call("mission", {**await self.header(), **wanted})


def test_a_mission_is_driven_and_followed():
    steps = [
        {"do": "goto", "x": 2.4, "y": 3.9, "yaw": 0.0},
        {"do": "behaviour", "name": "move", "settings": {"length": 0.2}},
        {"do": "record", "note": "in the hall"},
        {"do": "goto", "x": 99.0, "y": 99.0, "yaw": 0.0, "on_failure": "continue"},
        {"do": "wait", "seconds": 3.0},
        {"do": "return"},
    ]
    slides = {"do": "behaviour", "name": "move", "settings": {"length": 0.2, "bearing": 1.57}}
    mission, wrong = (
        Mission.model_validate_json(json.dumps({"version": 2, "name": "hall", "steps": some}))
        for some in (steps, [steps[0], slides])
    )
    lines, ends = [], []

    async def story(trip: Trip) -> None:
        client = MissionOperator(trip.rig.daemon, trip.clock)
        with pytest.raises(InputError, match=r"^step 2: .*this body cannot move sideways"):
            await run_mission(client, wrong, arm=True)
        with trip.rig.bus.subscribe(topics.MISSION, fifo(4096)) as states:
            ends.append(await run_mission(client, mission, arm=True, report=lines.append))
            ends.append(states.latest)

    rig = travel(story)
    end, state = ends
    assert end.reason is Reason.MISSION_INCOMPLETE, end.text
    assert (end.figures["failures"], end.figures["step"]) == (1, 6)
    assert state.steps == 6
    assert [line.partition("step ")[2][:1] for line in lines if " step " in line] == list("123456")
    others = [line for line in lines if " step " not in line]
    assert len(others) == 1, others
    assert " s  it failed: " in others[0]
    assert_at(rig, 1.0, 3.95, 0.0)


def test_the_shipped_mission_is_one():
    from monstertruckd.tools.cli.mission import load

    assert len(load(Path(__file__).resolve().parents[2] / "configs" / "missions" / "rooms.yaml").steps) == 6


@pytest.mark.parametrize("driven", [0.0, 3.0])
def test_a_robot_with_a_path_of_its_own_waits_where_it_is(tmp_path: Path, driven: float):
    """Armed for the mission, it would drive along the path meanwhile; one that does already stops."""
    file = tmp_path / "ahead.csv"
    file.write_text("x,y,yaw,direction\n" + "".join(f"{1.0 + i / 10},3.95,0,1\n" for i in range(31)))
    steps = [{"do": "wait", "seconds": 8.0}]
    mission = Mission.model_validate_json(json.dumps({"version": 2, "name": "stay", "steps": steps}))
    at: list[float] = []

    async def story(trip: Trip) -> None:
        if driven:
            await trip.arm()
            await trip.clock.sleep(driven)
        at.append(trip.rig.truth.array()[-1, 1])
        end = await run_mission(MissionOperator(trip.rig.daemon, trip.clock), mission, arm=True)
        assert end.reason is Reason.MISSION_DONE, end.text

    rig = travel(story, path={"file": file, "closed": False})
    assert (at[0] > 1.3) == (driven > 0.0)
    assert_at(rig, at[0], 3.95, 0.0)
