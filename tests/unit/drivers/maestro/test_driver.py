"""The driver against the emulator on the virtual clock: commands, deadman, battery."""

import math
from types import SimpleNamespace

import pytest

from monstertruck_drivers.maestro.config import BatteryInputConfig, MaestroConfig, ServoConfig
from monstertruck_drivers.maestro.driver import BatteryInput, MaestroDriver
from monstertruck_drivers.maestro.protocol import Code, Decoder, Encoder, ServoCommand
from monstertruck_drivers.maestro.session import MaestroSession
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import BatteryLevel, DriveFeedback, DriveMode
from tests.unit.drivers.maestro.rig import Rig, on_bench

LINE = MaestroConfig(deadman_channel=2)


def test_commands_become_pulses_at_once_and_feedback_follows_the_ramp():
    async def test(rig: Rig) -> None:
        rig.gate.front, rig.gate.rear = 0.2, -0.1
        async with rig.driving():
            await rig.out.count(3)
            assert rig.pulse(1) == pytest.approx(1439.2 - 10.48 * math.degrees(0.2), abs=0.13)
            assert rig.pulse(0) == pytest.approx(1439.2 + 10.48 * math.degrees(0.1), abs=0.13)
            feedback = rig.out.kept[-1]
            assert feedback.front == pytest.approx(0.2, abs=0.001)
            assert feedback.rear == pytest.approx(-0.1, abs=0.001)
            assert feedback.trusted
            assert feedback.error_word == 0
            assert feedback.stamp <= feedback.received
            rig.gate.front = -0.4
            await rig.settle(0.08)
            feedback = rig.out.kept[-1]
            assert -0.39 < feedback.front < 0.15, "speed 100 takes 0.14 s: the pulse is on its way"
            await rig.settle(0.3)
            assert rig.out.kept[-1].front == pytest.approx(-0.4, abs=0.001)
        assert rig.events.kept == []

    on_bench(test)


WHEELS = MaestroConfig(front_right=ServoConfig(channel=2), rear_right=ServoConfig(channel=3))


def test_every_wheel_may_have_its_own_servo():
    async def test(rig: Rig) -> None:
        rig.gate.front, rig.gate.rear, rig.gate.right = 0.2, -0.1, (-0.2, 0.3)
        async with rig.driving():
            await rig.settle(1.0)
            pulses = {channel: rig.pulse(channel) for channel in (1, 2, 0, 3)}
            for pulse, angle in zip(pulses.values(), (0.2, -0.2, -0.1, 0.3), strict=True):
                assert pulse == pytest.approx(1439.2 - 10.48 * math.degrees(angle), abs=0.13)
            feedback = rig.out.kept[-1]
            assert feedback.servos == pytest.approx((0.2, -0.2, -0.1, 0.3), abs=0.001)
            assert feedback.trusted
            assert rig.battery.kept
        assert rig.events.kept == []

    on_bench(test, WHEELS)


def test_a_command_reaches_the_device_without_waiting_for_the_poll():
    async def test(rig: Rig) -> None:
        rig.gate.talking = False
        async with rig.driving():
            await rig.settle(1.0)
            rig.gate.talking = True
            await rig.settle(0.021)
            assert rig.pulse(1) is not None

    on_bench(test, MaestroConfig(poll_rate=1.0, command_timeout=1.0))


def test_rates_are_those_configured():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(1)
            feedback, battery = len(rig.out.kept), len(rig.battery.kept)
            await rig.settle(10)
            assert len(rig.out.kept) - feedback == pytest.approx(200, abs=2)
            assert len(rig.battery.kept) - battery == pytest.approx(100, abs=2)
        assert [m.seq for m in rig.out.kept] == list(range(len(rig.out.kept)))

    on_bench(test)


def test_before_the_first_command_nothing_pulses_and_feedback_says_so():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(10)
            assert rig.pulse(1) is None
            assert not rig.out.kept[-1].trusted
            assert rig.outputs == []
        assert rig.events.kept == []

    on_bench(test, LINE, gate=False, serial_timeout_s=0.5)


def test_a_stale_command_from_before_the_session_is_not_obeyed():
    async def test(rig: Rig) -> None:
        await rig.settle(0.1)
        rig.gate.talking = False
        await rig.settle(1.0)
        async with rig.driving():
            await rig.settle(1.0)
            assert rig.pulse(1) is None

    on_bench(test)


def targets(rig: Rig, channel: int) -> list[int]:
    """All targets a channel was given, quarter microseconds."""
    given = Decoder().feed(bytes(rig.emulator.received))
    return [
        item.value
        for item in given
        if isinstance(item, ServoCommand) and item.code is Code.SET_TARGET and item.data[0] == channel
    ]


def test_the_line_is_driven_well_to_either_side_of_its_threshold():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
        await rig.settle(0.1)
        assert set(targets(rig, 2)) == {4000, 8000}

    on_bench(test, LINE)


def test_the_battery_is_read_by_the_first_poll():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(1)
            assert len(rig.battery.kept) == 1

    on_bench(test)


def test_an_error_alone_makes_feedback_untrusted():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            assert rig.out.kept[-1].trusted
            rig.emulator.inject("error", "1")
            await rig.settle(0.2)
            assert rig.pulse(1) is not None
        assert [sample.trusted for sample in rig.out.kept if sample.error_word] == [False]

    on_bench(test)


@pytest.mark.parametrize("error", [DeviceTimeoutError("silence"), ProtocolError("rubbish")])
@pytest.mark.parametrize(("between", "ends"), [(99, True), (2, False)])
def test_three_polls_in_a_row_without_an_answer_end_a_session(monkeypatch, error: Exception, between: int, ends: bool):
    ask, polls = MaestroSession.ask, 0

    async def failing(session: MaestroSession, *requests: bytes) -> list[int]:
        nonlocal polls
        polls += bool(rig_ready)
        if not rig_ready or polls % (between + 1) == 0:
            return await ask(session, *requests)
        raise error

    monkeypatch.setattr(MaestroSession, "ask", failing)
    rig_ready: list[int] = []

    async def test(rig: Rig) -> None:
        rig.ready = lambda: rig_ready.append(1)  # type: ignore[method-assign]
        if ends:
            with pytest.raises(type(error)):
                await rig.session()
            assert polls == 3
        else:
            async with rig.driving():
                await rig.settle(1.0)
            assert polls > 15

    on_bench(test)


def test_every_command_is_sent_once():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            before = len(targets(rig, 1))
            for step in range(1, 6):
                rig.gate.front = step / 10
                await rig.settle(0.02)
        assert len(set(targets(rig, 1)[before:])) == 5
        assert len(targets(rig, 1)[before:]) == 5

    on_bench(test)


def test_what_a_maestro_forgets_at_power_up_is_sent_at_the_beginning_of_a_session():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(1)
        given = Decoder().feed(bytes(rig.emulator.received))
        settings = [
            (item.code, item.data[0], item.value)
            for item in given
            if isinstance(item, ServoCommand) and item.code in (Code.SET_SPEED, Code.SET_ACCELERATION)
        ]
        assert settings == [
            (Code.SET_SPEED, 1, 100),
            (Code.SET_ACCELERATION, 1, 9),
            (Code.SET_SPEED, 0, 80),
            (Code.SET_ACCELERATION, 0, 0),
        ]

    config = MaestroConfig(front=ServoConfig(channel=1, acceleration=9), rear=ServoConfig(channel=0, speed=80))
    on_bench(test, config, gate=False)


def test_an_error_in_the_first_answer_of_a_session_is_reported():
    async def test(rig: Rig) -> None:
        rig.ready = lambda: rig.emulator.inject("error", "1")  # type: ignore[method-assign]
        async with rig.driving():
            await rig.out.count(1)
        assert [event[0] for event in rig.events.kept] == [Reason.DEVICE_FAULT]
        assert rig.out.kept[0].error_word == 2

    on_bench(test)


def speeds(rig: Rig) -> int:
    """How often the ramp of a servo was set."""
    given = Decoder().feed(bytes(rig.emulator.received))
    return sum(isinstance(item, ServoCommand) and item.code is Code.SET_SPEED and item.data[0] == 1 for item in given)


def test_after_a_lost_answer_everything_is_sent_again(monkeypatch):
    ask, lost = MaestroSession.ask, [False]

    async def losing(session: MaestroSession, *requests: bytes) -> list[int]:
        if lost[0]:
            lost[0] = False
            raise DeviceTimeoutError("silence")
        return await ask(session, *requests)

    monkeypatch.setattr(MaestroSession, "ask", losing)

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            before = speeds(rig)
            lost[0] = True
            await rig.settle(0.2)
            assert not lost[0]
            assert speeds(rig) == before + 1, "the lost answer may have held the only report of an error"

    on_bench(test)


def test_what_is_sent_again_after_commands_have_stopped_leaves_the_line_low():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.gate.talking = False
            await rig.settle(0.5)
            assert not rig.outputs[-1][1]
            before, changes = len(targets(rig, 1)), len(rig.outputs)
            rig.emulator.inject("error", "1")
            await rig.settle(0.2)
            assert len(targets(rig, 1)) > before, "sent again"
            assert len(rig.outputs) == changes

    on_bench(test, MaestroConfig(deadman_channel=2, deadman_feed="always"))


@pytest.mark.parametrize("feed", ["fresh", "always"])
def test_when_commands_stop_servos_hold_and_the_line_falls(feed: str):
    async def test(rig: Rig) -> None:
        rig.gate.front = 0.3
        async with rig.driving():
            await rig.settle(1.0)
            assert [level for _, level, _ in rig.outputs] == [True]
            pulse, stopped = rig.pulse(1), rig.clock.now()
            rig.gate.talking = False
            await rig.settle(2.0)
            assert rig.pulse(1) == pulse
            _, level, when = rig.outputs[-1]
            assert not level
            assert when - stopped <= 0.32 * SECOND
            assert rig.events.reasons() == [Reason.TICK_STALLED]
            silence = rig.clock.now() - rig.out.kept[-1].received
            if feed == "always":
                assert silence < 0.1 * SECOND
            else:
                assert silence > 1.5 * SECOND
            rig.gate.talking = True
            await rig.settle(0.2)
            assert rig.outputs[-1][1]
            assert rig.out.kept[-1].trusted
        timed_out = any(word.error_word & 0x20 for word in rig.out.kept)
        assert timed_out == (feed == "fresh"), "silence lets the device's own time-out trip"

    on_bench(test, MaestroConfig(deadman_channel=2, deadman_feed=feed), serial_timeout_s=0.5)


def test_a_hung_driver_drops_the_line_by_the_serial_timeout():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(1.0)
            hung = rig.clock.now()
            rig.port.device.faults.deaf = True
            rig.gate.talking = False
            await rig.settle(0.7)
            _, level, when = rig.outputs[-1]
            assert not level
            assert when - hung <= 0.51 * SECOND
            rig.port.device.faults.deaf = False

    with pytest.raises(DeviceTimeoutError):  # the driver noticed too
        on_bench(test, MaestroConfig(deadman_channel=2, deadman_feed="always"), serial_timeout_s=0.5)


def test_a_command_lowers_and_raises_the_line_and_a_restore_keeps_it_so():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.gate.deadman = False
            await rig.settle(0.03)
            assert not rig.outputs[-1][1]
            changes = len(rig.outputs)
            rig.emulator.inject("error", "0")
            await rig.settle(0.2)
            assert len(rig.outputs) == changes, "not even for a moment"
            assert rig.out.kept[-1].received > rig.clock.now() - SECOND // 10, "polling goes on"
            rig.gate.deadman = True
            await rig.settle(0.03)
            assert rig.outputs[-1][1]

    on_bench(test, LINE)


def test_ending_the_session_releases_the_line():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            assert rig.outputs[-1][1]
        await rig.settle(0.01)
        assert not rig.outputs[-1][1]

    on_bench(test, LINE)


def test_an_error_word_makes_feedback_untrusted_and_everything_is_sent_again():
    async def test(rig: Rig) -> None:
        rig.gate.front = 0.3
        async with rig.driving():
            await rig.settle(0.5)
            rig.gate.talking = False  # so that only the driver itself can restore the targets
            rig.emulator.inject("at_junk")
            assert rig.pulse(1) is None, "home is off here"
            assert not rig.outputs[-1][1]
            await rig.settle(0.06)
            assert rig.pulse(1) == pytest.approx(1439.2 - 10.48 * math.degrees(0.3), abs=0.13)
            assert rig.outputs[-1][1]
            wrong = [m for m in rig.out.kept if m.error_word]
            assert [(m.error_word, m.trusted) for m in wrong] == [(0x10, False)]
            assert wrong[0].front == pytest.approx(0.3, abs=0.001), "no pulses: the servo stays where it was"
            await rig.settle(0.1)
            assert rig.out.kept[-1].trusted
        reason, _, text, values = rig.events.kept[0]
        assert reason is Reason.DEVICE_FAULT
        assert "protocol" in text
        assert values == {"error_word": 0x10}

    on_bench(test, LINE, home={0: "off", 1: "off", 2: "off"})


def test_lasting_errors_are_reported_once():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            for _ in range(20):
                await rig.settle(0.05)
                rig.emulator.inject("error", "1")
            await rig.settle(0.2)
        assert rig.events.reasons() == [Reason.DEVICE_FAULT]

    on_bench(test)


@pytest.mark.parametrize("channel", [0, 1])
def test_a_single_servo_without_pulses_is_noticed(channel: int):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.gate.talking = False
            rig.port.device.take(Encoder().set_target(channel, 0))
            await rig.settle(0.1)
            assert rig.pulse(channel) is not None
            assert "pulses off" in rig.events.kept[0][2]
        assert sum(not sample.trusted for sample in rig.out.kept[5:]) == 1

    on_bench(test)


def test_lost_pulses_are_noticed_without_an_error_word():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.gate.talking = False
            rig.emulator.power_cycle()
            rig.port.device.take(b"\xa1")  # somebody else read the error
            await rig.settle(0.1)
            assert rig.pulse(1) is not None
            assert "pulses off" in rig.events.kept[0][2]

    on_bench(test)


@pytest.mark.parametrize("options", [{"use_crc": True}, {"device_number": 12}, {"device_number": 12, "use_crc": True}])
def test_every_form_of_the_protocol(options: dict):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
            assert rig.out.kept[-1].trusted
        assert rig.events.kept == []

    on_bench(test, MaestroConfig(**options), crc=options.get("use_crc", False))


def test_pending_power_up_errors_are_no_news():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("at_junk")
        async with rig.driving():
            await rig.out.count(3)
        assert all(m.error_word == 0 for m in rig.out.kept)

    on_bench(test)


# Battery


def test_the_battery_is_read_judged_and_reported():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("battery", "23.5")
        async with rig.driving():
            await rig.settle(3)
            battery = rig.battery.kept[-1]
            assert battery.voltage == pytest.approx(23.5, abs=0.1)
            assert battery.raw_voltage == pytest.approx(23.5, abs=0.2)
            assert (battery.level, battery.cells) == (BatteryLevel.NORMAL, 6)
            rig.emulator.inject("battery", "21.5")
            await rig.settle(11)
            assert rig.battery.kept[-1].level is BatteryLevel.LOW
            rig.emulator.inject("battery", "19")
            await rig.settle(3)
            assert rig.battery.kept[-1].level is BatteryLevel.CRITICAL
            rig.emulator.inject("battery", "0")
            await rig.settle(1)
            assert rig.battery.kept[-1].level is BatteryLevel.SENSOR_FAULT
            assert rig.battery.kept[-1].voltage is None
        assert rig.events.reasons() == [Reason.BATTERY_LOW, Reason.BATTERY_CRITICAL, Reason.DEVICE_FAULT]

    on_bench(test)


def test_the_motors_current_explains_the_batterys_sag():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("battery", "22.0")
        now = rig.clock.now()
        feedback = DriveFeedback(
            stamp=now, received=now, seq=0, position=0.0, velocity=0.0, current=5.0, mode=DriveMode.ENABLED
        )
        rig.drive.put(feedback)
        async with rig.driving():
            await rig.settle(0.5)
            battery = rig.battery.kept[-1]
            assert battery.voltage is not None
            assert battery.rest_voltage == pytest.approx(battery.voltage + 0.3)

    on_bench(test)


def test_without_a_battery_input_none_is_read():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
        assert rig.battery.kept == []
        assert b"\x90\x05" not in bytes(rig.emulator.received)

    on_bench(test, MaestroConfig(battery=None))


def test_the_battery_is_read_no_more_often_than_the_rest():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(5)
        assert len(rig.battery.kept) == len(rig.out.kept)
        assert [sample.stamp for sample in rig.battery.kept] == [sample.stamp for sample in rig.out.kept]

    on_bench(test, MaestroConfig(poll_rate=5.0, battery_rate=50.0))


def test_a_battery_that_is_measured_elsewhere_is_not_read():
    async def test(rig: Rig) -> None:
        rig.driver = MaestroDriver(MaestroConfig(), rig.port, rig.clock, rig.commands, rig.out, None, rig.events)
        async with rig.driving():
            await rig.out.count(3)
        assert b"\x90\x05" not in bytes(rig.emulator.received)

    on_bench(test)


@pytest.mark.parametrize(("raw", "at_limit"), [(0, True), (1, False), (1022, False), (1023, True)])
def test_a_reading_at_either_end_of_the_scale_is_no_measurement(raw: int, at_limit: bool):
    taken = []
    monitor = SimpleNamespace(take=lambda *given, at_limit, current: taken.append((*given, at_limit, current)))
    config = MaestroConfig().battery
    assert config is not None
    BatteryInput(config, monitor).take(3, 5, raw)  # type: ignore[arg-type]
    assert taken == [(3, 5, config.volts(raw), at_limit, None)]


@pytest.mark.parametrize(("reverse", "amps"), [(False, 2.0), (True, -2.0)])
def test_a_hall_sensor_measures_the_current_into_the_pack(reverse: bool, amps: float):
    taken = []
    monitor = SimpleNamespace(take=lambda *_, current, **__: taken.append(current))
    config = BatteryInputConfig.model_validate({"current": {"channel": 4, "reverse": reverse}})
    battery = BatteryInput(config, monitor)  # type: ignore[arg-type]
    assert battery.channels == [5, 4]
    battery.take(3, 5, 500, round(2.7 / 5.0 * 1023))
    assert taken == [pytest.approx(amps, abs=0.05)]


# Samples


def test_feedback_is_of_the_middle_of_its_question():
    async def test(rig: Rig) -> None:
        rig.port.device.faults.delay = 0.02
        async with rig.driving():
            await rig.out.count(5)
        delays = [(sample.received - sample.stamp) / SECOND for sample in rig.out.kept]
        assert delays == pytest.approx([0.02] * len(delays), abs=1e-6), "there and back"

    on_bench(test)


@pytest.mark.parametrize(("late", "obeyed"), [(0, True), (1, False)])
def test_a_command_is_obeyed_to_the_last_instant_of_its_time(late: int, obeyed: bool):
    async def test(rig: Rig) -> None:
        stamp = rig.clock.now() - SECOND // 4 - late
        command = SteeringCommand(
            stamp=stamp, received=stamp, seq=0, front=0.0, rear=0.0, front_servo=0.1, rear_servo=0.0
        )
        assert rig.driver._is_fresh(command) is obeyed

    on_bench(test, gate=False)
