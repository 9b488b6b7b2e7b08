"""The driver against the emulated bus on the virtual clock: goals, rates, other devices."""

import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import Ax12Config, JointConfig
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import (
    DeviceMismatchError,
    DeviceTimeoutError,
    WrongDeviceError,
)
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import TorqueState
from tests.unit.drivers.ax12.rig import FAST, Rig, on_bench, requests
from tests.unit.drivers.kit import background

STEP = p.STEP


@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize("chunk", [None, 1])
def test_goals_become_motion_and_feedback_follows(echo: bool, chunk: int | None):
    async def test(rig: Rig) -> None:
        rig.port.device.faults.chunk = chunk
        async with rig.driving():
            await rig.settle(0.3)
            rig.request(0.2, -0.3)
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
            rig.request(0.1, 0.1)
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
            rig.request(2.0, -0.2)
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
                rig.request(0.001 * i, 0.0)
                await rig.settle(0.02)
            assert 25 <= (len(rig.out.kept) - before) / 2 <= 32
            assert rig.joint("pitch") == pytest.approx(0.099, abs=0.02)
        assert rig.events.kept == []

    on_bench(test, Ax12Config(rate=50.0), latency_s=0.016)


def test_a_slow_line_makes_no_answer_late():
    """9615 baud: reading a unit's settings takes 30 ms on the line alone."""

    async def test(rig: Rig) -> None:
        for ident in (1, 2):
            rig.unit(ident).put(p.BAUD_CODE, 207)
        async with rig.driving():
            await rig.settle(1.0)
            rig.request(0.2, -0.3)
            await rig.settle(2.0)
            feedback = rig.out.kept[-1]
            assert feedback.pitch == pytest.approx(0.2, abs=2 * STEP)
            assert feedback.roll == pytest.approx(-0.3, abs=2 * STEP)
        assert rig.events.kept == []

    on_bench(test, host_baud=9615)


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
            rig.request(0.3, 0.0, age=0.6)
            await rig.settle(1)
            assert rig.joint("pitch") == pytest.approx(0.1, abs=STEP), "stale goals are not obeyed"
            rig.request(0.2, 0.0, age=0.4)
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
        with pytest.raises(DeviceTimeoutError, match="silent; expected AX-12A units 1 and 2: check the 12 V rail"):
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
        rig.port.device.baud = 500_000
        with pytest.raises(WrongDeviceError, match="another baud rate than 500000, or several units with one id"):
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
def test_a_unit_that_answers_too_little_is_set_to_answer_all(level: int):
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
