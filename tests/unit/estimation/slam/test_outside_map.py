"""Map from off board: who may send one, and which are refused."""

import asyncio
import zlib

import numpy as np
import pytest

from monstertruck_estimation.slam.outside_map import OutsideMap
from monstertruck_runtime.clock import run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.threads import inline
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import MapRequest, Role
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.bus.local import Bus

CELLS = np.array([0, 100, -1, 50, 7, 0], np.int8)


def outcome(**fields):
    """Grid that one request gives, or None, and the reasons of its refusals with their texts."""
    found = []

    async def main(clock):
        bus = Bus(clock)
        events, grids = bus.subscribe(t.EVENT, fifo(10)), bus.subscribe(t.MAP, latest())
        gate = bus.publisher(t.GATE, t.Writer.GATE)
        inputs = bus.subscribe(t.REQ_MAP, latest()), bus.subscribe(t.GATE, latest())
        service = OutsideMap(clock, *inputs, bus.publisher(t.MAP, t.Writer.ESTIMATION), bus.event_sink(), inline)
        running = asyncio.create_task(service.run())
        now = clock.now()
        gate.put(GateState(stamp=now, received=now, seq=0, mode=GateMode.DISARMED, nonce="n1", speed_limit=0.2))
        request = {"seq": 1, "source": "ros2:map_server", "role": Role.STATION, "nonce": "n1"}
        request |= {"resolution": 0.05, "width": 3, "height": 2, "packed": zlib.compress(CELLS.tobytes())}
        origin = Pose2D(x=-1.0, y=-2.0, yaw=0.0)
        head = {"stamp": now, "received": now, "lease": 1.0, "origin": origin}
        bus.inject(t.REQ_MAP, MapRequest(**head | request | fields))
        await clock.sleep(0.01)
        running.cancel()
        found.extend((grids.latest, [(event.reason, event.text) for event in events.drain()]))

    run_virtual(main)
    return found


def test_a_map_is_published_as_the_robots():
    grid, refusals = outcome()
    assert refusals == []
    assert (grid.frame, grid.resolution, grid.width, grid.height, grid.origin.y) == ("map", 0.05, 3, 2, -2.0)
    assert grid.cells.tolist() == CELLS.tolist()


@pytest.mark.parametrize(
    ("fields", "reason", "text"),
    [
        ({"nonce": "n0"}, Reason.BAD_NONCE, ""),
        ({"role": Role.TRACKER}, Reason.BAD_ROLE, ""),
        ({"packed": b"no zlib"}, Reason.BAD_INPUT, "map: compressed data: "),
        ({"packed": zlib.compress(bytes(5))}, Reason.BAD_INPUT, "map: 5 of 6 cells"),
        ({"packed": zlib.compress(bytes(10**8), 9)}, Reason.BAD_INPUT, "map: more than 6 cells"),
        ({"packed": zlib.compress(b"\x65" * 6)}, Reason.BAD_INPUT, "map: cells: expected -1 to 100"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused_with_its_source(fields, reason, text):
    grid, refusals = outcome(**fields)
    assert grid is None
    assert [row[0] for row in refusals] == [reason]
    assert refusals[0][1].startswith("map of ros2:map_server refused: ")
    assert text in refusals[0][1]
