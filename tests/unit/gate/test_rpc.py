"""Orders by remote call: answered with their outcome, and checked as those by topic are."""

import asyncio
import json
from contextlib import asynccontextmanager
from types import SimpleNamespace

import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import InputError, NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.requests import parse_request
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, Order, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import GATE, REQ_CONTROL, Writer
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.gate.service import register_gate_calls
from tests.unit.gate.bench import Bench
from tests.unit.gate.rig import NONCE


class CalledBench(Bench):
    """A gate service on a bus, with the calls of its orders."""

    def __init__(self, clock):
        self.bus = Bus(clock)
        super().__init__(clock, state=self.bus.publisher(GATE, Writer.GATE))
        self.states = self.bus.subscribe(GATE, latest())
        self.bus.listen(REQ_CONTROL, self.service.control)
        self.rpc = Rpc(clock)
        register_gate_calls(self.rpc, self.bus, clock)
        self.seq = 0

    def payload(self, **changes):
        self.seq += 1
        now = self.clock.now()
        known = {"nonce": NONCE, "gate_stamp": now}
        who = {"source": "ann", "role": "station", "lease": 1.0}
        return {"stamp": now, "received": now, "seq": self.seq, **who, **known, **changes}

    async def call(self, name, **changes):
        return (await self.rpc.call(name, self.payload(**changes)))["mode"]

    @asynccontextmanager
    async def driving(self):
        """Armed, with a gamepad driving."""
        await self.call("arm")
        self.speed = 0.1
        asking = asyncio.create_task(self._drive())
        await self.clock.sleep(0.2)
        assert self.service.mode is GateMode.DRIVING
        yield
        asking.cancel()

    async def _drive(self):
        while True:
            self.ask(self.service.request, Role.GAMEPAD)
            await self.clock.sleep(0.05)


def called(scenario):
    async def main(clock):
        bench = CalledBench(clock)
        async with bench.running():
            await scenario(bench)

    run_virtual(main)


def test_arm_is_answered_once_the_gate_is_armed():
    async def scenario(bench):
        begin = bench.clock.now()
        state = wire.decode(GATE, json.dumps(await bench.rpc.call("arm", bench.payload())).encode())
        assert (state.mode, state.nonce) == (GateMode.ARMED, NONCE)
        assert state.stamp > begin
        assert bench.clock.now() - begin <= SECOND // 50, "at the next tick"
        assert await bench.call("arm") == "armed", "armed already"

    called(scenario)


def test_disarm_is_answered_once_the_truck_stands():
    async def scenario(bench):
        async with bench.driving():
            answer = asyncio.create_task(bench.call("disarm"))
            await bench.clock.sleep(0.3)
            assert not answer.done()
            assert bench.service.mode is GateMode.STOPPING
            bench.speed = 0.0
            assert await answer == "disarmed"

    called(scenario)


@pytest.mark.parametrize("order", ["stop", "disarm"])
@pytest.mark.parametrize("armed", [True, False])
def test_an_order_to_stop_a_truck_that_still_moves_is_not_done_and_says_so_after_4_s(order, armed):
    async def scenario(bench):
        if armed:
            await bench.call("arm")
        bench.speed = 0.15
        began = bench.clock.now()
        await bench.clock.sleep(0.1)
        with pytest.raises(NoAnswerError, match=r"not confirmed after 4 s: .*a motor turns without a command"):
            await bench.call(order)
        assert bench.clock.now() - began >= 4 * SECOND
        state = bench.states.latest
        assert state.stopping
        assert state.mode_text == "estopped, stopping"
        bench.speed = 0.0
        assert await bench.call(order) == "estopped"

    called(scenario)


def test_a_gate_that_does_not_tick_gives_no_answer():
    async def main(clock):
        bench = CalledBench(clock)
        with pytest.raises(NoAnswerError, match="disarm accepted, but standstill is not confirmed after 4 s"):
            await bench.call("disarm")

    run_virtual(main)


def test_an_observer_may_order_an_emergency_stop_and_nothing_else():
    roles = {}
    register_gate_calls(SimpleNamespace(register=lambda name, _, role: roles.update({name: role})), None, None)
    assert roles == {order.value: AccessRole.OBSERVER if order is Order.ESTOP else AccessRole.PILOT for order in Order}


def test_stop_is_answered_at_rest_and_leaves_the_truck_armed():
    async def scenario(bench):
        async with bench.driving():
            answer = asyncio.create_task(bench.call("stop"))
            await bench.clock.sleep(0.1)
            assert not answer.done()
            bench.speed = 0.0
            assert await answer == "armed"

    called(scenario)


def test_estop_and_reset_are_answered_at_once():
    async def scenario(bench):
        async with bench.driving():
            assert await bench.call("estop") == "estopped"
            with pytest.raises(RequestRefusedError) as refused:
                await bench.call("reset")
            assert refused.value.refusal is Reason.NOT_ARMED_SPEED
            with pytest.raises(RequestRefusedError) as refused:
                await bench.call("arm")
            assert refused.value.refusal is Reason.ESTOPPED
            assert "emergency stop by ann" in str(refused.value)
        bench.speed = 0.0
        await bench.clock.sleep(0.5)
        assert await bench.call("reset") == "disarmed"
        assert await bench.call("reset") == "disarmed", "nothing to reset"

    called(scenario)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"nonce": "run-0"}, Reason.BAD_NONCE),
        ({"nonce": ""}, Reason.BAD_NONCE),
        ({"seq": 0}, Reason.BAD_SEQUENCE),
        ({"gate_stamp": None}, Reason.LEASE_EXPIRED),
        ({"gate_stamp": 1}, Reason.LEASE_EXPIRED),
        ({"role": "tracker"}, Reason.BAD_ROLE),
        ({"role": "estop"}, Reason.BAD_ROLE),
    ],
)
@pytest.mark.parametrize("way", ["call", "topic"])
def test_what_is_not_authentic_never_arms(way, changes, reason):
    async def scenario(bench):
        await bench.call("disarm")  # uses a sequence number
        await bench.clock.sleep(1.0)
        if way == "call":
            with pytest.raises(RequestRefusedError) as refused:
                await bench.call("arm", **changes)
            assert refused.value.refusal is reason
        else:
            request = parse_request(ControlRequest, bench.payload(order="arm", **changes))
            ((found, _),) = bench.bus.inject(REQ_CONTROL, request)
            assert found is reason
        await bench.clock.sleep(0.2)
        assert bench.service.mode is GateMode.DISARMED

    called(scenario)


def test_a_newer_client_may_say_more():
    async def scenario(bench):
        assert await bench.call("estop", more=1) == "estopped"

    called(scenario)


@pytest.mark.parametrize("payload", [{}, {"lease": 3.0}, {"lease": float("nan")}, {"source": "a b"}])
def test_what_is_no_request_is_refused(payload):
    async def scenario(bench):
        whole = {**bench.payload(), **payload} if payload else {}
        with pytest.raises((InputError, RequestRefusedError)):
            await bench.rpc.call("arm", whole)
        assert bench.service.mode is GateMode.DISARMED

    called(scenario)


def test_the_name_of_the_call_is_the_order():
    async def scenario(bench):
        assert await bench.call("disarm", order="arm") == "disarmed"

    called(scenario)


@pytest.mark.parametrize("first", ["call", "topic"])
def test_an_order_serves_by_one_way_only(first):
    async def scenario(bench):
        payload = bench.payload()
        request = parse_request(ControlRequest, {**payload, "order": "arm"})
        if first == "topic":
            bench.bus.inject(REQ_CONTROL, request)
            await bench.call("disarm")
            with pytest.raises(RequestRefusedError) as refused:
                await bench.rpc.call("arm", payload)
            assert refused.value.refusal is Reason.BAD_SEQUENCE
        else:
            await bench.rpc.call("arm", payload)
            await bench.call("disarm")
            bench.bus.inject(REQ_CONTROL, request)
        await bench.clock.sleep(0.1)
        assert bench.service.mode is GateMode.DISARMED

    called(scenario)


@pytest.mark.parametrize("order", ["stop", "estop"])
def test_an_arm_order_that_a_later_stop_has_overtaken_is_refused(order):
    async def scenario(bench):
        early, late = bench.payload(), bench.payload()
        bench.bus.inject(REQ_CONTROL, parse_request(ControlRequest, {**late, "order": order}))
        with pytest.raises(RequestRefusedError) as refused:
            await bench.rpc.call("arm", early)
        assert refused.value.refusal is Reason.BAD_SEQUENCE
        assert not bench.service.mode.active

    called(scenario)


def test_a_stop_that_is_not_authentic_uses_nobodys_sequence_number():
    async def scenario(bench):
        forged = bench.payload(seq=1 << 40, nonce="guess")
        bench.bus.inject(REQ_CONTROL, parse_request(ControlRequest, {**forged, "order": "stop"}))
        assert await bench.call("arm") == "armed"

    called(scenario)


def test_called_orders_are_published_as_those_by_topic():
    async def scenario(bench):
        seen = bench.bus.subscribe(REQ_CONTROL, fifo(9))
        await bench.call("arm", received=1)
        (order,) = seen.drain()
        assert (order.order, order.source) == (Order.ARM, "ann")
        assert order.received > SECOND // 20, "by the daemon's own clock"

    called(scenario)


def test_an_emergency_stop_in_the_same_instant_is_the_answer_of_arm():
    async def scenario(bench):
        answer = asyncio.create_task(bench.call("arm"))
        await asyncio.sleep(0)
        bench.order(Order.ESTOP)
        with pytest.raises(RequestRefusedError) as refused:
            await answer
        assert refused.value.refusal is Reason.ESTOPPED

    called(scenario)


@pytest.mark.parametrize("stop", ["stop", "estop"])
def test_a_stop_that_is_not_authentic_overtakes_every_order_that_starts(stop):
    async def scenario(bench):
        if stop == "estop":
            await bench.call("arm")
            await bench.call("estop")
        early = bench.payload()
        await bench.clock.sleep(0.001)
        forged = bench.payload(nonce="guess")
        bench.bus.inject(REQ_CONTROL, parse_request(ControlRequest, {**forged, "order": stop}))
        with pytest.raises(RequestRefusedError) as refused:
            await bench.rpc.call("arm" if stop == "stop" else "reset", early)
        assert refused.value.refusal is Reason.BAD_SEQUENCE

    called(scenario)
