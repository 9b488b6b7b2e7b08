"""The driver against the emulated bus on the virtual clock: goals, echo, absence, alarms, wrong devices."""

from itertools import pairwise

import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import AlarmConfig, Ax12Config, JointConfig
from monstertruck_drivers.ax12.probe import probe
from monstertruck_drivers.cable import MemoryPort
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    PortBusyError,
    WrongDeviceError,
)
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import TorqueState
from tests.unit.drivers.ax12.rig import FAST, Rig, bench
from tests.unit.drivers.kit import background

STEP = p.STEP
ALARM = AlarmConfig(rest=1.0, rest_max=4.0, settled_after=10.0)


def on_bench(test, config: Ax12Config | None = None, **options):
    """Run ``test(rig)`` on the virtual clock."""

    async def main(clock: VirtualClock) -> None:
        async with bench(clock, config, **options) as rig:
            await test(rig)

    run_virtual(main)


def requests(rig: Rig) -> list[p.Packet]:
    """Everything the host sent so far."""
    return p.Parser().feed(bytes(rig.bus.received))


@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize("chunk", [None, 1])
def test_goals_become_motion_and_feedback_follows(echo: bool, chunk: int | None):
    async def test(rig: Rig) -> None:
        rig.port.device.faults.chunk = chunk
        async with rig.driving():
            await rig.settle(0.3)
            rig.wish(0.2, -0.3)
            await rig.settle(0.03)
            feedback = rig.out.kept[-1]
            assert 0 < feedback.pitch < 0.2
            assert 0 < feedback.pitch_joint.velocity <= 4.05
            assert feedback.roll_joint.velocity < 0
            assert feedback.pitch_joint.load > 0 > feedback.roll_joint.load
            await rig.settle(0.7)
            feedback = rig.out.kept[-1]
            assert feedback.pitch == pytest.approx(0.2, abs=2 * STEP)
            assert feedback.roll == pytest.approx(-0.3, abs=2 * STEP)
            assert rig.joint("pitch") == pytest.approx(feedback.pitch, abs=STEP)
            assert rig.joint("roll") == pytest.approx(feedback.roll, abs=STEP)
            for joint in (feedback.pitch_joint, feedback.roll_joint):
                assert joint.torque is TorqueState.HOLDING
                assert joint.error == 0
                assert joint.voltage == pytest.approx(11.1)
                assert joint.temperature == pytest.approx(25)
                assert joint.velocity == 0
            assert feedback.stamp < feedback.received <= rig.clock.now()
        assert rig.events.kept == []
        assert len(rig.ready_at) == 1

    on_bench(test, echo=echo)


def test_goals_go_out_at_once_in_one_packet_with_no_answer():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.305)
            rig.bus.received.clear()
            rig.wish(0.1, 0.1)
            await rig.settle(0.001)
            (packet,) = requests(rig)
            assert packet.encode() == p.sync_write(
                p.GOAL_POSITION, {1: p.GOAL_POSITION.encode(531), 2: p.GOAL_POSITION.encode(224)}
            )

    on_bench(test, FAST.model_copy(update={"rate": 10.0}))


@pytest.mark.parametrize("direction", [1, -1])
def test_signs_and_limits(direction: int):
    joints = {
        "pitch": JointConfig(id=1, zero=511, min_position=409, max_position=613, direction=direction),
        "roll": JointConfig(id=2, zero=204, min_position=102, max_position=306, direction=-direction),
    }

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.3)
            rig.wish(2.0, -0.2)
            await rig.settle(1.5)
            shaft = rig.bus.angle(1, rig.clock.now()) / STEP
            assert shaft == pytest.approx(613 if direction > 0 else 409, abs=1.1), "held at the limit"
            feedback = rig.out.kept[-1]
            assert feedback.pitch == pytest.approx(102 * STEP, abs=2 * STEP)
            assert feedback.roll == pytest.approx(-0.2, abs=2 * STEP)

    on_bench(test, FAST.model_copy(update=joints))


def test_both_joints_are_read_at_the_configured_rate_with_low_latency():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            before = len(rig.out.kept)
            await rig.settle(2)
            assert len(rig.out.kept) - before == pytest.approx(100, abs=1)
            assert [message.seq for message in rig.out.kept] == list(range(len(rig.out.kept)))
            latest = rig.out.kept[-1]
            assert latest.received - latest.stamp < 0.003 * SECOND
            rig.bus.received.clear()
            await rig.settle(1.0)
            sent = [packet.params for packet in requests(rig) if packet.unit == 1]
            assert sent.count(bytes((36, 8))) == pytest.approx(50, abs=1)
            assert sent.count(bytes((24, 12))) == 1, "torque settings once a second"

    on_bench(test)


def test_a_slow_adapter_slows_the_rate_and_nothing_else():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            before = len(rig.out.kept)
            for i in range(100):
                rig.wish(0.001 * i, 0.0)
                await rig.settle(0.02)
            assert 25 <= (len(rig.out.kept) - before) / 2 <= 32
            assert rig.joint("pitch") == pytest.approx(0.099, abs=0.02)
        assert rig.events.kept == []

    on_bench(test, Ax12Config(rate=50.0), latency_s=0.016)


def test_timeouts_follow_the_adapter():
    assert FAST.timeout(22) == 0.005
    assert Ax12Config().timeout(22) == pytest.approx(0.0347, abs=1e-4)
    assert Ax12Config(usb_latency=0.016, return_delay=0.0).timeout(22) > 2 * 0.016


def test_the_units_hold_before_the_first_goal_and_after_the_last():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            assert rig.joint("pitch") == pytest.approx(0.1, abs=STEP)
            assert rig.unit(1).get(p.TORQUE_ENABLE) == 1
            rig.wish(0.3, 0.0, age=0.6)
            await rig.settle(1)
            assert rig.joint("pitch") == pytest.approx(0.1, abs=STEP), "stale goals are not obeyed"
            rig.wish(0.2, 0.0, age=0.4)
            await rig.settle(1)
            held = rig.joint("pitch")
            assert held == pytest.approx(0.2, abs=2 * STEP)
            await rig.settle(5)
            assert rig.joint("pitch") == held
        await rig.settle(1)
        assert rig.joint("pitch") == held
        assert rig.unit(1).get(p.TORQUE_ENABLE) == 1

    on_bench(test, positions={1: FAST.pitch.position(0.1), 2: 204})


def test_a_joint_pushed_beyond_its_limits_is_brought_back_to_them():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            assert rig.bus.angle(1, rig.clock.now()) / STEP == pytest.approx(613, abs=1.1)

    on_bench(test, positions={1: 660, 2: 204})


def test_settings_reach_the_unit():
    config = FAST.model_copy(update={"speed": 2.0, "margin": 2, "slope": 64})

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.2)
            unit = rig.unit(2)
            assert [unit.get(r) for r in (p.CW_MARGIN, p.CCW_MARGIN, p.CW_SLOPE, p.CCW_SLOPE)] == [2, 2, 64, 64]
            assert unit.get(p.MOVING_SPEED) * p.SPEED_UNIT == pytest.approx(2.0, abs=p.SPEED_UNIT)

    on_bench(test, config)


# Identity


def test_silence_is_a_timeout_with_advice():
    async def test(rig: Rig) -> None:
        with pytest.raises(DeviceTimeoutError, match="silence; expected AX-12A units 1 and 2: is the 12 V rail up"):
            await rig.session()
        assert rig.ready_at == []

    on_bench(test, ids=())
    on_bench(test, ids=(), echo=True)


def test_another_device_is_refused():
    async def test(rig: Rig) -> None:
        async def stream() -> None:
            while True:
                rig.port.device.write(b"$C320.5P0.2R-18.3T19.0*3C\r\n")
                await rig.settle(0.02)

        async with background(stream()):
            with pytest.raises(WrongDeviceError, match="bytes, but no answer of an AX-12A: another device"):
                await rig.session()

    on_bench(test, ids=())


def test_other_units_are_refused():
    async def test(rig: Rig) -> None:
        rig.unit(2).put(p.MODEL_NUMBER, 29)
        with pytest.raises(WrongDeviceError, match=r"unit 2 \(roll\): model 29, expected an AX-12A"):
            await rig.session()

    on_bench(test)


def test_two_units_of_one_number_are_refused():
    async def test(rig: Rig) -> None:
        with pytest.raises(WrongDeviceError, match="several units with one id"):
            await rig.session()

    on_bench(test, ids=(1, 1))


@pytest.mark.parametrize(("low", "high"), [(0, 0), (450, 1023), (0, 600)])
def test_limits_that_contradict_the_configuration_are_refused(low: int, high: int):
    async def test(rig: Rig) -> None:
        rig.unit(1).put(p.CW_LIMIT, low)
        rig.unit(1).put(p.CCW_LIMIT, high)
        with pytest.raises(DeviceMismatchError, match=rf"unit 1 \(pitch\): its angle limits are {low}\.\.{high}"):
            await rig.session()
        assert rig.unit(1).get(p.TORQUE_ENABLE) == 0

    on_bench(test)


@pytest.mark.parametrize("level", [0, 1])
def test_a_unit_that_answers_too_little_is_told_to_answer_all(level: int):
    async def test(rig: Rig) -> None:
        rig.unit(1).put(p.STATUS_LEVEL, level)
        async with rig.driving():
            await rig.settle(1)
            assert rig.unit(1).get(p.STATUS_LEVEL) == 2
            assert rig.out.kept[-1].pitch_joint.torque is TorqueState.HOLDING
        ((reason, severity, text, _),) = rig.events.kept
        assert (reason, severity) == (Reason.DEVICE_MISMATCH, Severity.INFO)
        assert "unit 1" in text

    on_bench(test)


@pytest.mark.parametrize("echo", [False, True])
def test_an_undervolted_unit_is_not_mistaken_for_an_echo(echo: bool):
    """Its answer to a ping equals the ping."""

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            feedback = rig.out.kept[-1]
            assert feedback.pitch_joint.error == p.Alarm.VOLTAGE
            assert feedback.pitch_joint.voltage == pytest.approx(5.5)
            assert feedback.pitch_joint.torque is TorqueState.HOLDING
        assert rig.events.reasons() == [Reason.DEVICE_FAULT] * 2
        assert "voltage" in rig.events.kept[0][2]

    on_bench(test, echo=echo, voltage=lambda _: 5.5)


# Loss


@pytest.mark.parametrize("echo", [False, True])
def test_one_absent_unit_leaves_the_other_working_and_is_asked_once_a_second(echo: bool):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            feedback = rig.out.kept[-1]
            assert (feedback.roll, feedback.roll_joint.torque) == (None, TorqueState.ABSENT)
            assert feedback.roll_joint.voltage is None
            rig.wish(0.2, 0.2)
            await rig.settle(1)
            assert rig.joint("pitch") == pytest.approx(0.2, abs=2 * STEP)
            rig.bus.received.clear()
            before = len(rig.out.kept)
            await rig.settle(5)
            asked = [packet for packet in requests(rig) if packet.unit == 2]
            assert 4 <= len(asked) <= 5
            assert len(rig.out.kept) - before >= 240
            rig.bus.inject("return", "2")
            await rig.settle(1.2)
            assert rig.out.kept[-1].roll_joint.torque is TorqueState.HOLDING
            rig.wish(0.0, 0.2)
            await rig.settle(1)
            assert rig.joint("roll") == pytest.approx(0.2, abs=2 * STEP)
        assert rig.events.reasons() == [Reason.DEVICE_TIMEOUT, Reason.DEVICE_READY]

    async def started(rig: Rig) -> None:
        rig.bus.inject("vanish", "2")
        await test(rig)

    on_bench(started, echo=echo)


def test_a_unit_that_vanishes_is_missed_after_two_retries():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1.005)
            rig.bus.inject("vanish", "1")
            gone = rig.clock.now()
            rig.bus.received.clear()
            await rig.settle(0.9)
            lost = next(message for message in rig.out.kept if message.pitch_joint.torque is TorqueState.ABSENT)
            assert lost.received - gone < 0.08 * SECOND
            assert lost.pitch is None
            assert lost.roll is not None
            assert len([packet for packet in requests(rig) if packet.unit == 1]) == 3
        ((reason, severity, text, _),) = rig.events.kept
        assert (reason, severity) == (Reason.DEVICE_TIMEOUT, Severity.WARNING)
        assert "pitch joint (unit 1) does not answer" in text

    on_bench(test)


def test_all_units_gone_ends_the_session():
    async def test(rig: Rig) -> None:
        async with rig.driving() as task:
            await rig.settle(1)
            rig.bus.inject("power", "off")
            await rig.settle(0.2)
            assert task.done()
            await task

    with pytest.raises(DeviceTimeoutError, match="no unit answers any more: is the 12 V rail down"):
        on_bench(test)


def test_unplugging_ends_the_session_and_the_next_one_works():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            rig.port.unplug()
            await rig.settle(0.03)

    async def twice(rig: Rig) -> None:
        with pytest.raises(DeviceLostError):
            await test(rig)
        rig.port.plug()
        async with rig.driving():
            await rig.settle(0.5)
            rig.wish(0.1, 0.0)
            await rig.settle(0.5)
            assert rig.joint("pitch") == pytest.approx(0.1, abs=2 * STEP)

    on_bench(twice)


@pytest.mark.parametrize("damage", ["truncate", "garble", "double", "mute", "late 0.004", "late 0.015", "late 0.03"])
@pytest.mark.parametrize("echo", [False, True])
def test_single_damaged_answers_cost_nothing_but_themselves(damage: str, echo: bool):
    async def test(rig: Rig) -> None:
        fault, *values = damage.split()
        async with rig.driving():
            await rig.settle(1)
            rig.wish(0.15, -0.15)
            for _ in range(20):
                rig.bus.inject(fault, *values)
                await rig.settle(0.093)
            assert {message.roll_joint.torque for message in rig.out.kept[10:]} == {TorqueState.HOLDING}
            assert {message.pitch_joint.torque for message in rig.out.kept[10:]} == {TorqueState.HOLDING}
            assert rig.out.kept[-1].pitch == pytest.approx(0.15, abs=2 * STEP)
            assert rig.out.kept[-1].roll == pytest.approx(-0.15, abs=2 * STEP)
        assert rig.events.kept == []

    on_bench(test, echo=echo)


@pytest.mark.parametrize("echo", [False, True])
def test_bit_errors_never_make_a_wrong_angle(echo: bool):
    async def test(rig: Rig) -> None:
        faults = rig.port.device.faults
        async with rig.driving():
            await rig.settle(1)
            faults.seed(3)
            faults.flip_rate = 0.003
            await rig.settle(20)
            faults.flip_rate = 0.0
            await rig.settle(2)
            for message in rig.out.kept:
                assert message.pitch in (None, 0.0)
                assert message.roll in (None, 0.0)
            assert rig.out.kept[-1].pitch == rig.out.kept[-1].roll == 0.0

    on_bench(test, echo=echo)


# Alarms


def overload(rig: Rig, ident: int) -> None:
    rig.bus.inject("trip", str(ident))


def test_an_overloaded_joint_rests_and_holds_again_without_a_jump():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.wish(0.3, 0.3)
            await rig.settle(1)
            rig.bus.inject("trip", "1")
            tripped = rig.clock.now()
            await rig.settle(0.1)
            feedback = rig.out.kept[-1]
            assert feedback.pitch_joint.torque is TorqueState.LIMP
            assert feedback.pitch_joint.error == p.Alarm.OVERLOAD
            assert feedback.roll_joint.torque is TorqueState.HOLDING
            rig.unit(1).position = 511.0  # sagged while limp
            goal = rig.unit(1).get(p.GOAL_POSITION)
            rig.wish(-0.3, 0.1)
            await rig.settle(0.7)
            assert rig.joint("pitch") == 0.0
            assert rig.unit(1).get(p.GOAL_POSITION) == goal, "a limp joint is given no goals"
            assert rig.joint("roll") == pytest.approx(0.1, abs=2 * STEP), "the other one works on"
            speeds = []
            while rig.out.kept[-1].pitch_joint.torque is not TorqueState.HOLDING:
                await rig.settle(0.01)
                speeds.append(rig.out.kept[-1].pitch_joint.velocity)
            assert rig.clock.now() - tripped == pytest.approx(1.0 * SECOND, abs=0.1 * SECOND)
            assert rig.out.kept[-1].pitch_joint.error == 0
            await rig.settle(0.5)
            assert rig.joint("pitch") == pytest.approx(0, abs=STEP), "it waits for a goal where it is"
            assert set(speeds) == {0.0}
            rig.wish(-0.3, 0.1)
            await rig.settle(1)
            assert rig.joint("pitch") == pytest.approx(-0.3, abs=2 * STEP)
        reports, limp, again = rig.events.kept
        assert "reports overload" in reports[2]
        assert limp[:2] == (Reason.DEVICE_FAULT, Severity.ERROR)
        assert limp[3] == {"error": 32}
        assert again[:2] == (Reason.DEVICE_READY, Severity.INFO)

    on_bench(test, FAST.model_copy(update={"alarm": ALARM}))


def test_the_trap_limp_without_an_error_bit_is_found():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            rig.unit(2).put(p.TORQUE_LIMIT, 0)
            await rig.settle(2.2)
            limp = [message for message in rig.out.kept if message.roll_joint.torque is TorqueState.LIMP]
            assert 40 <= len(limp[1:]) <= 60, "a second of rest"
            assert {message.roll_joint.error for message in limp} == {0}
            assert rig.out.kept[-1].roll_joint.torque is TorqueState.HOLDING
            assert rig.unit(2).get(p.TORQUE_LIMIT) == 1023

    on_bench(test, FAST.model_copy(update={"alarm": ALARM}))


def test_a_joint_that_stays_blocked_rests_longer_each_time():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.bus.inject("block", "1", "on")
            limp: list[float] = []
            was = TorqueState.HOLDING
            for _ in range(1500):
                rig.wish(0.4, 0.0)
                await rig.settle(0.02)
                now = rig.out.kept[-1].pitch_joint.torque
                if now is not was and now is TorqueState.LIMP:
                    limp.append(rig.clock.now() / SECOND)
                was = now
            gaps = [after - before for before, after in pairwise(limp)]
            assert gaps[:4] == pytest.approx([2.1, 3.1, 5.1, 5.1], abs=0.3), "1, 2, 4, 4 s and a second to trip"
            rig.bus.inject("block", "1", "off")
            await rig.settle(5)
            assert rig.out.kept[-1].pitch_joint.torque is TorqueState.HOLDING
            before = len(rig.events.kept)
            await rig.settle(11)
            overload(rig, 1)
            await rig.settle(1.2)
            assert rig.out.kept[-1].pitch_joint.torque is TorqueState.HOLDING, "settled: the first rest again"
            assert len(rig.events.kept) - before == 3

    on_bench(test, FAST.model_copy(update={"alarm": ALARM}))


def test_a_hot_joint_is_left_to_cool():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.bus.inject("heat", "1", "75")
            await rig.settle(5)
            feedback = rig.out.kept[-1]
            assert feedback.pitch_joint.torque is TorqueState.LIMP
            assert feedback.pitch_joint.error == p.Alarm.OVERHEAT
            assert feedback.pitch_joint.temperature > 60
            while rig.out.kept[-1].pitch_joint.torque is TorqueState.LIMP:
                await rig.settle(1)
            assert rig.out.kept[-1].pitch_joint.temperature == 60
            assert rig.clock.now() > 20 * SECOND

    on_bench(test, FAST.model_copy(update={"alarm": ALARM}))


def test_torque_that_does_not_come_back_is_tried_again_ever_later():
    """The unit's own limit (70) is below the configured one: it shuts down at once."""

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.bus.inject("heat", "1", "78")
            await rig.settle(0.2)
            rig.bus.received.clear()
            tried: list[float] = []
            for _ in range(800):
                await rig.settle(0.01)
                if any(packet.params[:1] == bytes((p.GOAL_POSITION.address,)) for packet in requests(rig)):
                    tried.append(rig.clock.now() / SECOND)
                rig.bus.received.clear()
            assert [after - before for before, after in pairwise(tried)] == pytest.approx([2.0, 4.0], abs=0.1)
            assert rig.out.kept[-1].pitch_joint.torque is TorqueState.LIMP
        errors = [event for event in rig.events.kept if event[1] is Severity.ERROR]
        assert len(errors) == 1, "one outage, one report"

    alarm = ALARM.model_copy(update={"cool_below": 90})
    on_bench(test, FAST.model_copy(update={"alarm": alarm}))


def test_a_hot_unit_is_not_given_torque_at_the_start():
    async def test(rig: Rig) -> None:
        rig.bus.inject("heat", "1", "68")
        async with rig.driving():
            await rig.settle(1)
            assert rig.out.kept[-1].pitch_joint.torque is TorqueState.LIMP
            assert rig.unit(1).get(p.TORQUE_ENABLE) == 0

    on_bench(test)


def test_a_brown_out_of_one_unit_is_noticed_and_repaired():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.wish(0.2, 0.0)
            await rig.settle(1)
            rig.unit(1).power(False, rig.clock.now())
            rig.unit(1).power(True, rig.clock.now())
            await rig.settle(1.1)
            assert rig.unit(1).get(p.TORQUE_ENABLE) == 1
            assert rig.unit(1).get(p.MOVING_SPEED) == FAST.speed_word
            assert rig.joint("pitch") == pytest.approx(0.2, abs=2 * STEP)
        ((reason, _, text, _),) = rig.events.kept
        assert reason is Reason.DEVICE_FAULT
        assert "lost its settings" in text

    on_bench(test)


def test_a_lost_speed_limit_is_noticed_and_repaired():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            rig.unit(1).put(p.MOVING_SPEED, 0)  # unlimited
            await rig.settle(1.1)
            assert rig.unit(1).get(p.MOVING_SPEED) == FAST.speed_word

    on_bench(test)


def test_a_reduced_greatest_torque_is_respected():
    async def test(rig: Rig) -> None:
        rig.unit(1).put(p.MAX_TORQUE, 600)
        async with rig.driving():
            await rig.settle(0.5)
            assert rig.unit(1).get(p.TORQUE_LIMIT) == 600

    on_bench(test)


def test_a_bit_that_comes_and_goes_is_reported_once():
    volts = [11.1]

    async def test(rig: Rig) -> None:
        async with rig.driving():
            for i in range(20):
                volts[0] = 5.5 if i % 2 else 11.1
                await rig.settle(0.2)
            volts[0] = 11.1
            await rig.settle(12)
            volts[0] = 5.5
            await rig.settle(0.2)
        assert rig.events.reasons() == [Reason.DEVICE_FAULT] * 4, "each joint, and again after a clean while"

    on_bench(test, FAST.model_copy(update={"alarm": ALARM}), voltage=lambda _: volts[0])


# Probe


@pytest.mark.parametrize("echo", [False, True])
def test_probe_describes_and_moves_nothing(echo: bool):
    async def test(rig: Rig) -> None:
        rig.unit(4).put(p.STATUS_LEVEL, 0)
        found = await probe(rig.port, rig.clock)
        assert found["echo"] is echo
        assert [unit["id"] for unit in found["units"]] == [1, 2, 4]
        assert found["units"][0] == {
            "id": 1,
            "errors": "none",
            "model": 12,
            "firmware": 24,
            "limits": [0, 1023],
            "status_level": 2,
            "torque_enabled": False,
            "torque_limit": 1023,
            "position": 511,
            "voltage": 11.1,
            "temperature": 25,
        }
        assert "no correct answer" in found["units"][2]["unreadable"]
        assert {packet.code for packet in requests(rig)} == {p.Instruction.PING, p.Instruction.READ}

    on_bench(test, ids=(1, 2, 4), echo=echo)


def test_probe_of_nothing_and_of_others():
    async def silent(rig: Rig) -> None:
        with pytest.raises(DeviceTimeoutError, match="silence"):
            await probe(rig.port, rig.clock)

    async def other(rig: Rig) -> None:
        with pytest.raises(WrongDeviceError, match="bytes, but no answer"):
            await probe(rig.port, rig.clock)

    on_bench(silent, ids=())
    on_bench(other, ids=(1, 1, 1))


def test_the_port_has_one_owner():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.1)
            with pytest.raises(PortBusyError):
                await probe(rig.port, rig.clock)

    on_bench(test)


def test_nothing_plugged_in():
    async def main(clock: VirtualClock) -> None:
        with pytest.raises(DeviceLostError, match="not plugged in"):
            await probe(MemoryPort("/dev/test"), clock)

    run_virtual(main)
