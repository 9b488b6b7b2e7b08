"""The driver through absence and damage, alarms and their recovery; the probe."""

from itertools import pairwise

import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import AlarmConfig
from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    PortBusyError,
    WrongDeviceError,
)
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import TorqueState
from tests.unit.drivers.ax12.rig import FAST, Rig, on_bench, requests

STEP = p.STEP
ALARM = AlarmConfig(rest=1.0, rest_max=4.0, settled_after=10.0)


# Loss


@pytest.mark.parametrize("echo", [False, True])
def test_one_absent_unit_leaves_the_other_working_and_is_asked_once_a_second(echo: bool):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1)
            feedback = rig.out.kept[-1]
            assert (feedback.roll, feedback.roll_joint.torque) == (None, TorqueState.ABSENT)
            assert feedback.roll_joint.voltage is None
            rig.request(0.2, 0.2)
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
            rig.request(0.0, 0.2)
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

    with pytest.raises(DeviceTimeoutError, match="no unit answers any more: check the 12 V rail"):
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
            rig.request(0.1, 0.0)
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
            rig.request(0.15, -0.15)
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
            rig.request(0.3, 0.3)
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
            rig.request(-0.3, 0.1)
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
            rig.request(-0.3, 0.1)
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
                rig.request(0.4, 0.0)
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
            rig.request(0.2, 0.0)
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
        found = await DEVICES["ax12"].identify(rig.port, rig.clock)
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
        with pytest.raises(DeviceTimeoutError, match="silent"):
            await DEVICES["ax12"].identify(rig.port, rig.clock)

    async def other(rig: Rig) -> None:
        with pytest.raises(WrongDeviceError, match="bytes, but no answer"):
            await DEVICES["ax12"].identify(rig.port, rig.clock)

    on_bench(silent, ids=())
    on_bench(other, ids=(1, 1, 1))


def test_the_port_has_one_owner():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.1)
            with pytest.raises(PortBusyError):
                await DEVICES["ax12"].identify(rig.port, rig.clock)

    on_bench(test)


def test_nothing_plugged_in():
    async def main(clock: VirtualClock) -> None:
        with pytest.raises(DeviceLostError, match="not plugged in"):
            await DEVICES["ax12"].identify(MemoryPort("/dev/test"), clock)

    run_virtual(main)
