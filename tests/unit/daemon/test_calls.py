"""Remote calls leave a message in the log."""

import json

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.event import CALL_TEXT, Call
from monstertruck_schemas.reasons import Reason
from monstertruckd.bus.access import EVERYTHING, Sender
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.daemon import recording


def test_a_goal_by_call_is_published_with_its_waypoint_and_answer():
    async def main(clock: VirtualClock) -> list[Call]:
        bus = Bus(clock)
        calls = bus.subscribe(topics.CALL, fifo(10))
        rpc = Rpc(clock, record=recording(bus, clock))

        async def goal(payload: dict[str, object]) -> dict[str, object]:
            return {"number": 1}

        rpc.register("goal", goal)
        waypoint = json.dumps({"waypoints": [{"x": 1.5, "y": 2.0}]}).encode()
        await rpc.answer(Sender("ann", EVERYTHING), "goal", waypoint)
        await rpc.answer(Sender("ann", EVERYTHING), "goal", b'{"text": "' + b"x" * 10_000 + b'"}')
        return calls.drain()

    first, second = run_virtual(main)
    assert (first.name, first.source, first.reason) == ("goal", "ann", Reason.OK)
    assert json.loads(first.payload)["waypoints"] == [{"x": 1.5, "y": 2.0}]
    assert json.loads(first.answer) == {"number": 1}
    assert (first.seq + 1, len(second.payload)) == (second.seq, CALL_TEXT)
    assert topics.CALL.logged
