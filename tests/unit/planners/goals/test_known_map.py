"""The planner's map reaches operators of a robot that does not map."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from monstertruck_planners.goals.known_map import KnownMapService
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.map_files import load_map
from monstertruck_runtime.threads import inline
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import EVENT, MAP, Writer
from monstertruckd.bus.local import Bus
from monstertruckd.config.load import load_config
from monstertruckd.station import frames
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

ROOT = Path(__file__).resolve().parents[4]
ROOMS = ROOT / "configs/worlds/rooms.yaml"


async def published(clock: VirtualClock, place: Path):
    bus = Bus(clock)
    grids, events = bus.subscribe(MAP, latest()), bus.subscribe(EVENT, latest())
    out = bus.publisher(MAP, Writer.ESTIMATION)
    service = KnownMapService(place, "odom", clock, out, bus.event_sink(), inline)
    ready = asyncio.Event()
    running = asyncio.create_task(service.run(ready.set))
    await ready.wait()
    running.cancel()
    return grids.latest, events.latest


def test_it_is_published_as_it_is_in_the_file():
    async def main(clock: VirtualClock):
        grid, event = await published(clock, ROOMS)
        known = load_map(ROOMS)
        assert event is None
        assert (grid.frame, grid.resolution) == ("odom", known.resolution)
        assert (grid.origin.x, grid.origin.y) == known.origin
        assert np.array_equal(grid.cells.reshape(grid.height, grid.width), known.cells)

    run_virtual(main)


def test_a_file_that_cannot_be_read_is_an_event_and_the_service_goes_on(tmp_path: Path):
    async def main(clock: VirtualClock):
        grid, event = await published(clock, tmp_path / "gone.yaml")
        assert grid is None
        assert event.reason is Reason.FILE_DAMAGED

    run_virtual(main)


@pytest.mark.parametrize(("name", "mapped"), [("goals", True), ("explore", True), ("demo", False)])
def test_the_page_expects_a_map_of_robots_that_have_one(name: str, mapped: bool):
    config = load_config(ROOT / f"configs/{name}.yaml", SimulatedTruckConfig)[0]
    facts = frames.facts(config.model_dump(mode="json"), {})
    assert f'"mapping":{str(mapped).lower()}' in facts
