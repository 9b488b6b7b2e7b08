"""Exploration in the whole daemon: an unknown world, goals, the way home, a saved map."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from monstertruck_estimation.slam.storage import load
from monstertruck_planners.goals.service import GoalService
from monstertruck_planners.track.service import TrackingStep
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap, load_map, save_map
from monstertruck_schemas import topics
from monstertruck_schemas.plan import ExplorationPhase
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder, GoalOrder
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(900)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"

START = {"x": 1.0, "y": 1.2, "yaw": 0.0}


def corner_room(folder: Path) -> Path:
    """A room round a corner: what is behind it is not seen from the start."""
    cells = np.full((120, 120), OCCUPIED, np.int8)
    cells[4:44, 4:116] = FREE
    cells[4:116, 76:116] = FREE
    cells[60:80, 76:84] = OCCUPIED
    save_map(WorldMap(cells, 0.05), folder / "corner.yaml")
    return folder / "corner.yaml"


class ExploringTruck:
    """A truck in the room, and somebody who asks it to explore."""

    def __init__(self, rig: VirtualRig) -> None:
        self.rig, self.clock = rig, rig.clock
        self.operator = LocalOperator(rig.daemon, rig.clock)
        self.states = rig.bus.subscribe(topics.EXPLORE, fifo(8192))
        self.events = rig.bus.subscribe(topics.EVENT, fifo(8192))

    async def order(self, order: ExploreOrder, **more) -> dict:
        return await self.operator.call("explore", {**await self.operator.header(), "order": order, **more})

    async def end(self, limit: float):
        async with self.clock.deadline(limit):
            while True:
                state = await self.states.next()
                if state.number and not state.running:
                    return state


def run_scenario(scenario, folder: Path, **overlay) -> tuple[ExploringTruck, np.ndarray]:
    """Let it happen; returns the scenario and the truth."""
    config = load_config(CONFIGS / "explore.yaml", SimulatedTruckConfig)[0]
    base = {
        "recorder": None,
        "blackbox": None,
        "placement": {"planner": "loop", "explorer": "loop"},
        "planner": {"route": {"effort": 3000}},
        "odometry": {"start": START},
        "slam": {"save": folder / "map"},
        "sim": {"world": {"map": str(corner_room(folder)), "start": START}},
    }
    config = with_overlay(with_overlay(config, base), overlay)

    async def main(clock: VirtualClock) -> tuple[ExploringTruck, np.ndarray]:
        rig = VirtualRig(config, clock)
        truck = ExploringTruck(rig)
        async with rig.running():
            await clock.sleep(4.0)
            await scenario(truck)
        return truck, rig.truth.array()

    return run_virtual(main, start=SECOND)


@pytest.mark.long
def test_it_explores_a_room_drives_home_and_saves_the_map(tmp_path: Path):
    ends = []

    async def scenario(truck: ExploringTruck) -> None:
        with pytest.raises(RequestRefusedError) as refused:
            await truck.order(ExploreOrder.START)
        assert refused.value.refusal is Reason.DISARMED
        await truck.operator.arm()
        assert await truck.order(ExploreOrder.START) == {"number": 1}
        with pytest.raises(RequestRefusedError, match="is running") as refused:
            await truck.order(ExploreOrder.START)
        ends.append(await truck.end(280.0))

    truck, truth = run_scenario(scenario, tmp_path)
    state = ends[0]
    assert state.outcome is Reason.EXPLORED, state.text
    assert not truth[:, 5].any(), "collided"
    assert math.dist(truth[-1, 1:3], truth[0, 1:3]) < 0.2, "not at home"
    assert state.travelled > 4.0
    grid = load(tmp_path / "map").grid
    assert (grid.cells == FREE).sum() * grid.resolution**2 > 14.0  # of 16.8 m^2, walls rounded off
    reasons = {event.reason for event in truck.events.drain() if event.source == "explorer"}
    assert {Reason.EXPLORATION_STARTED, Reason.FRONTIER_CHOSEN, Reason.EXPLORED} <= reasons


@pytest.mark.parametrize("budget", [None, pytest.param(6.0, marks=pytest.mark.long)])
def test_it_stops_on_request_and_gives_way_to_other_goals(budget: float | None, tmp_path: Path):
    ends = []

    async def scenario(truck: ExploringTruck) -> None:
        await truck.operator.arm()
        await truck.order(ExploreOrder.START)
        await truck.clock.sleep(5.0)
        await truck.order(ExploreOrder.STOP)
        ends.append(await truck.end(60.0))
        with pytest.raises(RequestRefusedError, match="no exploration"):
            await truck.order(ExploreOrder.STOP)
        await truck.order(ExploreOrder.START, home=False)
        await truck.clock.sleep(4.0)
        goal = {"goal": {"x": 2.6, "y": 1.2, "yaw": 0.0}, "frame": "map"}
        await truck.operator.call("goal", {**await truck.operator.header(), **goal})
        ends.append(await truck.end(60.0))

        if budget is not None:
            cancel = {**await truck.operator.header(), "order": GoalOrder.CANCEL}
            await truck.operator.call("goal_control", cancel)
            await truck.clock.sleep(2.0)
            await truck.order(ExploreOrder.START, home=True, budget=budget)
            spent = await truck.end(120.0)
            assert spent.outcome is Reason.BUDGET_SPENT
            assert "back at the start" in spent.text

    _, truth = run_scenario(scenario, tmp_path)
    assert [state.outcome for state in ends] == [Reason.CANCELLED, Reason.CANCELLED]
    assert "operator" in ends[0].text
    assert "goal of operator" in ends[1].text
    assert not truth[:, 5].any()
    assert ends[0].phase is ExplorationPhase.IDLE


@pytest.mark.parametrize(
    ("name", "work"),
    [
        ("goals", (GoalService, "_tick")),
        pytest.param("tracker", (TrackingStep, "_choose_path"), marks=pytest.mark.long),
    ],
)
def test_a_service_that_dies_by_a_bug_ends_it_with_its_name_and_a_saved_map(
    name: str, work: tuple[type, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    ends = []

    def bug(*_: object, **__: object) -> None:
        raise RuntimeError("a bug")

    async def scenario(truck: ExploringTruck) -> None:
        await truck.operator.arm()
        await truck.order(ExploreOrder.START, budget=600.0)
        await truck.clock.sleep(5.0)
        monkeypatch.setattr(*work, bug)
        ends.append(await truck.end(20.0))
        await truck.clock.sleep(1.0)

    _, truth = run_scenario(scenario, tmp_path)
    (state,) = ends
    assert (state.outcome, state.phase) == (Reason.SERVICE_FAILED, ExplorationPhase.IDLE)
    assert state.text.startswith(f"{name}: ")
    assert load(tmp_path / "map").grid.cells.any()
    assert truth[-1, 1:3] == pytest.approx(truth[-20, 1:3], abs=1e-3), "it stands"


def doubled(folder: Path) -> float:
    """Share of the saved map's walls that are more than 0.12 m from true ones."""
    saved = load(folder / "map").grid
    true = load_map(folder / "corner.yaml")
    far = distance_transform_edt(true.cells != OCCUPIED) * true.resolution
    rows, columns = np.nonzero(saved.cells == OCCUPIED)
    x = saved.origin[0] + (columns + 0.5) * saved.resolution
    y = saved.origin[1] + (rows + 0.5) * saved.resolution
    at = np.clip((np.column_stack((y, x)) / true.resolution).astype(int), 0, 119)
    return float((far[at[:, 0], at[:, 1]] > 0.12).mean())


@pytest.mark.long
def test_a_lidar_that_is_gone_for_a_while_stops_it_and_armed_again_it_goes_on(tmp_path: Path):
    ends = []

    async def scenario(truck: ExploringTruck) -> None:
        await truck.operator.arm()
        await truck.order(ExploreOrder.START, home=False)
        await truck.clock.sleep(8.0)
        truck.rig.ports["lidar"].unplug()
        await truck.clock.sleep(5.0)
        truck.rig.ports["lidar"].plug()
        await truck.clock.sleep(6.0)
        await truck.operator.arm()
        ends.append(await truck.end(200.0))

    _, truth = run_scenario(scenario, tmp_path)
    assert ends[0].outcome is Reason.EXPLORED, ends[0].text
    assert not truth[:, 5].any()
    assert doubled(tmp_path) < 0.05


@pytest.mark.long
def test_far_from_home_it_turns_back_while_the_charge_suffices(tmp_path: Path):
    ends = []

    async def scenario(truck: ExploringTruck) -> None:
        await truck.operator.arm()
        await truck.order(ExploreOrder.START)
        ends.append(await truck.end(200.0))

    _, truth = run_scenario(scenario, tmp_path, explorer={"full_range": 3.0})
    assert ends[0].outcome is Reason.CHARGE_SPENT
    assert "are reserved for" in ends[0].text
    assert "back at the start" in ends[0].text
    assert not truth[:, 5].any()
    assert math.dist(truth[-1, 1:3], truth[0, 1:3]) < 0.2
