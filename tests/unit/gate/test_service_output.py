"""What the gate's service publishes at each tick, and when."""

import asyncio
import logging
from itertools import pairwise

import pytest

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_schemas import topics
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.latch import MemoryLatch
from monstertruckd.gate.service import METER_DEPTH, GateOutputs, GateService, TickMeter
from tests.unit.gate.bench import Bench, Inbox, Outbox, on_bench
from tests.unit.gate.rig import BODIES, make_gate

PERIOD = SECOND // 50


@pytest.mark.parametrize(("count", "p50", "p99"), [(1, 1, 1), (2, 1, 2), (10, 5, 10), (100, 50, 99), (200, 100, 198)])
def test_percentiles_of_the_lateness_are_those_of_the_ordered_ticks(count, p50, p99):
    meter = TickMeter()
    assert meter.lateness() == type(meter.lateness())(0, 0.0, 0.0, 0.0)
    for value in reversed(range(1, count + 1)):
        meter.record(float(value))
    found = meter.lateness()
    assert (found.ticks, found.p50, found.p99, found.max) == (count, p50, p99, count)
    assert METER_DEPTH == len(meter._ring) == 4096


def test_commands_carry_time_number_and_motion():
    async def scenario(bench):
        bench.order(Order.ARM)
        await bench.clock.sleep(0.05)
        assert bench.ask(bench.service.request, Role.STATION) is Reason.OK
        await bench.clock.sleep(0.1)
        drive, steering, state = bench.out.drives[0].last, bench.out.steering.last, bench.out.state.last
        assert drive.stamp == drive.received == steering.stamp == steering.received
        assert (drive.seq, steering.seq) == (len(bench.out.drives[0].messages) - 1,) * 2
        assert drive.action is DriveAction.RUN
        assert drive.speed > 0
        assert drive.motor_velocity == pytest.approx(bench.service._gate._chassis.drivetrain.motor_rate(drive.speed))
        assert 0 < steering.front <= 0.1
        assert steering.front_servo != 0
        assert steering.deadman
        assert (state.holder, state.role, state.mode) == ("station", Role.STATION, GateMode.DRIVING)
        assert state.nonce == bench.service._gate.nonce
        assert state.twist.vx > 0
        assert (state.speed_limit, state.reasons, state.waiting) == (0.21, (), ())
        assert state.last_seq is not None
        assert state.lease_left > 0
        assert state.form is not None
        assert state.stopping_distance > 0
        assert state.seq == len(bench.out.state.messages) - 1

    on_bench(scenario)


def test_the_state_is_published_every_tenth_of_a_second_and_at_every_change():
    async def scenario(bench):
        await bench.clock.sleep(0.5)
        stamps = [state.stamp for state in bench.out.state.messages]
        assert {later - before for before, later in pairwise(stamps[2:])} == {5 * PERIOD}
        before = len(stamps)
        bench.order(Order.ARM)
        await bench.clock.sleep(0.021)
        assert len(bench.out.state.messages) > before
        assert bench.out.state.last.mode is GateMode.ARMED

    on_bench(scenario)


@pytest.mark.parametrize("order", [Order.STOP, Order.DISARM])
def test_an_order_that_stops_is_published_at_the_next_tick_though_it_changes_nothing(order):
    async def scenario(bench):
        await bench.clock.sleep(0.45)
        before = bench.out.state.last.stamp
        assert bench.order(order).reason is Reason.OK
        ordered = bench.clock.now()
        await bench.clock.sleep(0.021)
        state = bench.out.state.last
        assert state.mode is GateMode.DISARMED
        assert before < ordered <= state.stamp < before + 5 * PERIOD, "who knows this state may arm"

    on_bench(scenario)


def test_a_stop_that_was_ordered_is_news_and_any_other_a_warning(caplog):
    async def scenario(bench):
        caplog.set_level(logging.INFO)
        for ordered in (True, False):
            bench.order(Order.ARM)
            await bench.clock.sleep(0.05)
            bench.ask(bench.service.request, Role.STATION)
            await bench.clock.sleep(0.05)
            if ordered:
                bench.order(Order.STOP)
            await bench.clock.sleep(1.0)
            stop = bench.out.stops.last
            assert stop.ordered is ordered
            levels = {record.levelno for record in caplog.records if record.getMessage() == stop.text}
            assert levels == {logging.INFO if ordered else logging.WARNING}

    on_bench(scenario)


def test_events_and_stops_go_out_under_the_gates_name():
    async def scenario(bench):
        bench.order(Order.ARM)
        await bench.clock.sleep(0.05)
        bench.ask(bench.service.request, Role.STATION)
        await bench.clock.sleep(0.05)
        bench.order(Order.STOP)
        await bench.clock.sleep(0.05)
        assert {source for _, source, _, _ in bench.events} == {"gate"}
        assert [reason for reason, *_ in bench.events][:2] == [Reason.ARMED, Reason.DRIVING]
        assert bench.events[1][3] == {"role": "station", "by": "station"}
        stop = bench.out.stops.last
        assert (stop.number, stop.seq, stop.reason, stop.ordered, stop.quick) == (1, 0, Reason.STOPPED, True, False)
        assert (stop.holder, stop.role, stop.mode) == ("station", Role.STATION, GateMode.STOPPING)
        assert stop.text == "stopped: stop ordered by ann"
        assert (stop.black_box, bench.boxes) == ("box-1", [Reason.STOPPED])
        assert stop.stamp <= stop.received
        assert (stop.speed, stop.causes[0].source) == (0.0, "ann")
        assert stop.stopping_distance >= 0

    on_bench(scenario)


def test_every_shaft_gets_its_own_command():
    async def main(clock):
        outputs = GateOutputs((Outbox(), Outbox()), Outbox(), Outbox(), Outbox(), Outbox())
        inputs = {topic: Inbox() for topic in topics.DRIVES[:2]}
        gate = make_gate(chassis=BODIES["differential"])
        taken = []
        gate.observe = lambda message, topic: taken.append((message, topic))
        service = GateService(gate, 50, clock, inputs, outputs, lambda *_, **__: None, MemoryLatch())
        for shaft, inbox in enumerate(inputs.values()):
            inbox.latest = shaft
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.1)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert taken == list(enumerate(topics.DRIVES[:2])), "each once"
        assert len(outputs.drives[0].messages) == len(outputs.drives[1].messages) > 3

    run_virtual(main)


def test_settings_that_weaken_are_reported_at_the_start_and_in_every_state(caplog):
    async def main(clock):
        bench = Bench(clock)
        weak = ("gate.speed 1, default 0.21", "gate.turning null")
        service = GateService(
            bench.service._gate, 50, clock, _inputs(bench), bench.out, bench.note, MemoryLatch(), weakened=weak
        )
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.05)
        assert [(reason, text) for reason, _, text, _ in bench.events] == [(Reason.WEAKENED, each) for each in weak]
        assert bench.out.state.last.weakened == weak
        logged = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
        assert logged == [f"configured less safely than by default: {each}" for each in weak]
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main)


def _inputs(bench):
    return {
        topics.SCAN: bench.scan,
        topics.COMPASS: bench.attitude,
        topics.DRIVE: bench.drive,
        topics.STEERING: bench.steering,
        topics.BATTERY: bench.battery,
    }


class Disk(MemoryLatch):
    """A latch that notes what is asked of it, and fails as often as reported."""

    def __init__(self, failures=0, engaged=False):
        super().__init__(engaged)
        self.failures = failures
        self.asked = []
        self.marks = []
        self.closed = 0

    def mark(self, engaged):
        self.marks.append(engaged)

    def store(self, engaged):
        self.asked.append(engaged)
        if self.failures:
            self.failures -= 1
            raise OSError("disk")
        super().store(engaged)

    def close(self):
        self.closed += 1


def test_the_latch_is_tried_again_every_second_and_marked_until_it_is_stored():
    disk = Disk(failures=2)

    async def scenario(bench):
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.5)
        assert disk.asked == [True]
        assert not bench.out.state.last.latched
        await bench.clock.sleep(1.0)
        assert disk.asked == [True, True]
        await bench.clock.sleep(1.1)
        assert disk.asked == [True, True, True]
        assert bench.out.state.last.latched
        assert disk.marks == [False, True, False]
        await bench.clock.sleep(2.0)
        assert len(disk.asked) == 3
        errors = [text for reason, _, text, _ in bench.events if reason is Reason.RECORDING_FAILED]
        assert errors == ["the emergency stop's latch could not be stored: disk"] * 2

    on_bench(scenario, disk)
    assert disk.closed == 1


def test_a_stop_that_was_reset_before_it_could_be_stored_leaves_the_disk_alone():
    disk = Disk(failures=1)

    async def scenario(bench):
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.1)
        assert bench.order(Order.RESET).reason is Reason.OK
        await bench.clock.sleep(2.0)
        assert disk.asked == [True]
        assert disk.marks[-1] is False

    on_bench(scenario, disk)


def test_a_mark_stays_when_the_latch_could_not_be_stored_to_the_end():
    disk = Disk(failures=100)

    async def scenario(bench):
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.1)

    on_bench(scenario, disk)
    assert disk.closed == 0


def test_a_latch_that_agrees_is_not_written():
    disk = Disk(engaged=True)

    async def scenario(bench):
        await bench.clock.sleep(0.3)
        assert bench.out.state.last.mode is GateMode.ESTOPPED
        assert bench.out.state.last.latched
        assert not bench.out.steering.last.deadman

    on_bench(scenario, disk)
    assert (disk.asked, disk.marks, disk.closed) == ([], [False], 1)


def test_ticks_and_mode_are_shown_to_the_watchdog():
    async def scenario(bench):
        before = bench.service.ticks()
        await bench.clock.sleep(0.2)
        assert bench.service.ticks() - before == 10
        assert bench.service.mode is GateMode.DISARMED
        assert bench.readies == bench.service.ticks()

    on_bench(scenario)


def test_that_short_faults_repeat_is_logged_too(caplog):
    async def scenario(bench):
        for _ in range(GateConfig().short_faults):
            bench.service._gate._count_short_fault(bench.clock.now())
        await bench.clock.sleep(0.05)
        logged = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
        assert "4 stops for stale sensors within 10 s: disarmed" in logged

    on_bench(scenario)


def test_the_drives_ports_are_cut_once_when_neither_quick_stop_nor_power_off_helps():
    cuts = []

    async def main(clock):
        bench = Bench(clock)

        async def cut():
            cuts.append((clock.now(), bench.out.drives[0].last.action))

        bench.service._cut_ports = cut
        async with bench.running():
            bench.order(Order.ARM)
            await clock.sleep(0.1)
            bench.speed = 0.2
            await clock.sleep(3.0)
        return bench

    bench = run_virtual(main)
    actions = [command.action for command in bench.out.drives[0].messages]
    order = [action for action, before in zip(actions[1:], actions, strict=False) if action is not before]
    assert order[-3:] == [DriveAction.RUN, DriveAction.QUICK_STOP, DriveAction.DISABLE]
    assert [action for _, action in cuts] == [DriveAction.DISABLE]
    assert bench.boxes.count(Reason.UNCOMMANDED_MOTION) == 3
    assert not bench.out.steering.last.deadman


def test_the_ground_that_was_seen_is_published_about_once_a_second():
    async def scenario(bench):
        await bench.clock.sleep(3.5)
        seen = bench.out.seen.messages
        assert 2 <= len(seen) <= 4
        newest = seen[-1]
        assert (newest.frame, newest.width, newest.height) == ("base", 64, 64)
        assert newest.resolution * newest.width / 2 == -newest.origin.x == -newest.origin.y
        assert newest.cells.reshape(64, 64)[32, 32] >= 0, "under the body"
        assert (newest.cells < 0).any(), "behind it"

    on_bench(scenario)
