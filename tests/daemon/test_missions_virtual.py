"""A mission in the whole daemon: goals, a move, a note, and the way back."""

import asyncio
import json
from pathlib import Path

import pytest

from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.runs import run_mission
from monstertruckd.tools.simulation.operator import LocalOperator
from tests.daemon.goal_kit import Trip, assert_at, own_path, travel

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


class MissionOperator(LocalOperator):
    """Gives orders about missions as ``TruckClient`` does."""

    async def mission(self, order, mission=None, *, moved=False, own=False):
        steps = None if mission is None else mission.model_dump(mode="json")
        wanted = {"order": order, "mission": steps, "moved": moved, "own": own}
        return await self.call("mission", {**await self.header(), **wanted})


def test_a_mission_is_driven_and_followed():
    steps = [
        {"do": "goto", "x": 1.6, "y": 3.9, "yaw": 0.0},
        {"do": "behaviour", "name": "move", "settings": {"length": 0.2}},
        {"do": "record", "note": "in the hall"},
        {"do": "goto", "x": 99.0, "y": 99.0, "yaw": 0.0, "on_failure": "continue"},
        {"do": "wait", "seconds": 1.0},
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
    assert " s  failed: " in others[0]
    assert_at(rig, 1.0, 3.95, 0.0)


def test_the_shipped_missions_are_some():
    from monstertruckd.tools.cli.mission import load

    folder = Path(__file__).resolve().parents[2] / "configs" / "missions"
    assert {file.stem: len(load(file).steps) for file in folder.glob("*.yaml")} == {
        "rooms": 6,
        "patrol": 2,
        "charge": 1,
    }


@pytest.mark.parametrize("driven", [0.0, 3.0])
def test_a_robot_with_a_path_of_its_own_waits_where_it_is(tmp_path: Path, driven: float):
    """Armed for the mission, it would drive along the path meanwhile; one that does already stops."""
    file = own_path(tmp_path)
    steps = [{"do": "wait", "seconds": 4.0}]
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


class DistantOperator(MissionOperator):
    """Whose answers take a second."""

    async def call(self, rpc, payload=None):
        answer = await super().call(rpc, payload)
        await asyncio.sleep(1.0)
        return answer


@pytest.mark.parametrize("refused", [False, True])
def test_armed_for_a_mission_it_does_not_drive_its_own_path_before_that_begins(tmp_path: Path, refused: bool):
    steps = [{"do": "goto", "x": 0.97, "y": 3.95, "yaw": 0.0}, {"do": "wait", "seconds": 1.0}]
    mission = Mission.model_validate_json(json.dumps({"version": 2, "name": "stay", "steps": steps}))

    async def story(trip: Trip) -> None:
        client, starts = DistantOperator(trip.rig.daemon, trip.clock), []

        async def start(order, mission=None, *, moved=False, own=False):
            starts.append(order)
            if refused and len(starts) == 2:
                raise RequestRefusedError(Reason.BUSY)
            return await DistantOperator.mission(client, order, mission, moved=moved, own=own)

        client.mission = start
        if refused:
            with pytest.raises(RequestRefusedError):
                await run_mission(client, mission, arm=True)
        else:
            assert (await run_mission(client, mission, arm=True)).reason is Reason.MISSION_DONE
        await trip.clock.sleep(3.0)

    truth = travel(story, path={"file": own_path(tmp_path), "closed": False}).truth.array()
    assert abs(truth[:, 1] - 1.0).max() < 0.04
