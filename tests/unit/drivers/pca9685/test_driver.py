"""Driver against emulator, on the virtual clock."""

import math

import pytest

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.pca9685.config import Pca9685Config, Pca9685EscConfig
from monstertruck_drivers.pca9685.emulator import Pca9685Emulator
from monstertruck_drivers.pca9685.esc_driver import Pca9685EscDriver
from monstertruck_drivers.pca9685.protocol import PwmMode1, PwmRegister, pulse
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import (
    ConfigError,
    DeviceFaultError,
    DeviceLostError,
    DeviceTimeoutError,
    WrongDeviceError,
)
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveMode
from tests.unit.drivers.kit import background
from tests.unit.drivers.pca9685.rig import CONFIG, ESC, on_bench

FRONT, REAR, MOTOR = 0, 4, ESC.esc.channel


def test_it_steers_and_reports_the_pulses_read_back():
    async def test(rig):
        rig.front, rig.rear = 0.3, -0.2
        async with rig.driving():
            await rig.settle(0.3)
            assert rig.pulse(FRONT) == pytest.approx(CONFIG.front.pulse_us(0.3), abs=2.5)
            assert rig.pulse(REAR) == pytest.approx(CONFIG.rear.pulse_us(-0.2), abs=2.5)
            assert rig.steering.last.front == pytest.approx(0.3, abs=0.005)
            assert rig.steering.last.rear == pytest.approx(-0.2, abs=0.005)
            assert rig.steering.last.trusted
            assert len(rig.steering.kept) >= 5
            changed = rig.clock.now()
            rig.front = -0.3
            while rig.pulse(FRONT) == pytest.approx(CONFIG.front.pulse_us(0.3), abs=2.5):
                await rig.settle(0.001)
            assert rig.clock.now() - changed < 0.03 * SECOND
        assert not rig.events.kept
        assert rig.emulator.transfer(0x70, b"\x00", 1) is None, "all-call is off: other devices have that address"

    on_bench(test)


def test_before_the_first_command_nothing_is_steered():
    async def test(rig):
        rig.talking = False
        async with rig.driving():
            await rig.settle(0.3)
            assert rig.pulse(FRONT) is None
            assert not rig.steering.last.trusted

    on_bench(test)


def test_a_new_session_does_not_interrupt_pulses_of_the_right_frequency():
    async def test(rig):
        async with rig.driving():
            await rig.settle(0.3)
        before = rig.pulse(FRONT)
        rig.talking = False
        async with rig.driving():
            for _ in range(300):
                assert rig.pulse(FRONT) == before
                await rig.settle(0.001)

    on_bench(test)


def test_stale_commands_hold_the_servos_and_are_reported_once():
    async def test(rig):
        rig.front = 0.2
        async with rig.driving():
            await rig.settle(0.3)
            rig.talking = False
            await rig.settle(1.0)
            assert rig.pulse(FRONT) == pytest.approx(CONFIG.front.pulse_us(0.2), abs=2.5)
            assert rig.events.reasons() == [Reason.TICK_STALLED]

    on_bench(test)


def test_a_loss_of_supply_is_noticed_and_everything_written_again():
    async def test(rig):
        rig.front = 0.2
        async with rig.driving():
            await rig.settle(0.3)
            rig.talking = False
            rig.emulator.inject("brown_out")
            assert rig.pulse(FRONT) is None
            await rig.settle(0.15)
            assert rig.pulse(FRONT) == pytest.approx(CONFIG.front.pulse_us(0.2), abs=2.5)
            assert rig.events.reasons()[:1] == [Reason.DEVICE_FAULT]
            assert any(not one.trusted for one in rig.steering.kept)
            assert rig.steering.last.trusted

    on_bench(test)


def test_pulses_that_another_program_wrote_are_replaced_and_false_readings_reported_once():
    async def test(rig):
        async with rig.driving():
            await rig.settle(0.3)
            rig.emulator.transfer(0x40, pulse(FRONT, 400), 0)
            await rig.settle(0.1)
            assert rig.pulse(FRONT) == pytest.approx(CONFIG.front.centre_us, abs=2.5)
            rig.emulator.signals.inject(f"counts_{FRONT}", "offset", "20")
            await rig.settle(0.5)
            assert rig.events.reasons() == [Reason.DEVICE_FAULT]
            assert not rig.steering.last.trusted

    on_bench(test)


def test_lost_transfers_are_repeated_and_three_in_a_row_end_the_session():
    async def test(rig):
        rig.port.device.faults.seed(1)
        rig.port.device.faults.lose_rate = 0.02
        async with rig.driving():
            rig.front = 0.25
            await rig.settle(5.0)
            assert rig.pulse(FRONT) == pytest.approx(CONFIG.front.pulse_us(0.25), abs=2.5)
        rig.port.device.faults.lose_rate = 0.0

        async def vanish():
            await rig.settle(0.5)
            rig.emulator.inject("absent", "on")

        async with background(vanish()):
            with pytest.raises(DeviceTimeoutError, match="no acknowledgement of address 0x40"):
                await rig.session()

    on_bench(test)


def test_nothing_there_another_chip_and_a_pulled_bus():
    async def test(rig):
        rig.emulator.address = 0x41
        with pytest.raises(DeviceTimeoutError, match="no acknowledgement of address 0x40"):
            await rig.session()
        rig.emulator.address = 0x40
        for register in range(2, 6):
            rig.emulator.transfer(0x40, bytes((register, 0x39)), 0)
        before = rig.emulator.transfer(0x40, b"\x00", 1)
        with pytest.raises(WrongDeviceError, match="registers 2 to 5 are 39 39 39 39"):
            await rig.session()
        assert rig.emulator.transfer(0x40, b"\x00", 1) == before, "nothing was written to it"
        rig.emulator.power_cycle()

        async def pull():
            await rig.settle(0.5)
            rig.port.unplug()

        async with background(pull()):
            with pytest.raises(DeviceLostError):
                await rig.session()
        rig.port.plug()
        async with rig.driving():
            await rig.settle(0.3)
            assert rig.steering.last.trusted

    on_bench(test)


def test_a_wrong_oscillator_moves_the_pulse_and_the_setting_puts_it_right():
    async def test(rig):
        rig.emulator.inject("oscillator", "26e6")
        async with rig.driving():
            await rig.settle(0.3)
            assert rig.pulse(FRONT) == pytest.approx(CONFIG.front.centre_us * right, rel=0.003)

    right = 25 / 26
    on_bench(test)
    right = 1.0
    on_bench(test, Pca9685Config(oscillator=26e6))


def test_the_probe_reads_and_changes_nothing():
    async def test(rig):
        found = await DEVICES["pca9685"].identify(rig.port, rig.clock)
        assert (found["asleep"], found["prescaler"]) == (True, 30)
        assert rig.emulator.transfer(0x40, bytes((PwmRegister.MODE1,)), 1)[0] & PwmMode1.SLEEP
        async with rig.driving():
            await rig.settle(4.0)
        found = await DEVICES["pca9685_esc"].identify(rig.port, rig.clock, ESC)
        assert found["frequency_hz"] == pytest.approx(50, abs=0.3)
        assert found["channels"][MOTOR] == pytest.approx(1500, abs=3)

    on_bench(test, ESC)


def test_it_drives_and_steers_once_the_speed_controller_has_had_its_neutral_pulses():
    async def test(rig):
        rig.action, rig.rate, rig.front = DriveAction.RUN, 100.0, 0.2
        async with rig.driving():
            await rig.settle(1.5)
            assert rig.turning() == 0.0
            assert rig.pulse(MOTOR) == pytest.approx(1500, abs=3)
            await rig.settle(2.5)
            assert rig.turning() == pytest.approx(100.0, rel=0.03)
            assert rig.drive.last.velocity == pytest.approx(100.0)
            assert rig.drive.last.mode is DriveMode.ENABLED
            assert rig.steering.last.front == pytest.approx(0.2, abs=0.005)
            rig.action = DriveAction.QUICK_STOP
            await rig.settle(0.5)
            assert rig.turning() == 0.0
            rig.action, rig.rate = DriveAction.RUN, -50.0
            await rig.settle(1.0)
            assert rig.turning() == pytest.approx(-50.0, rel=0.05)
        await rig.settle(0.4)
        assert rig.turning() == 0.0, "the end of a session is neutral"

    on_bench(test, ESC)


def test_stale_commands_and_a_loss_of_supply_stop_the_motor():
    async def test(rig):
        rig.action, rig.rate = DriveAction.RUN, 100.0
        async with rig.driving():
            await rig.settle(4.0)
            rig.talking = False
            await rig.settle(0.8)
            assert rig.turning() == 0.0
            rig.emulator.inject("brown_out")
            await rig.settle(0.2)
            assert rig.pulse(MOTOR) == pytest.approx(1500, abs=3), "not the pulse of before"

    on_bench(test, ESC)


def test_a_dead_host_is_noticed_by_nothing_on_the_chip():
    async def test(rig):
        async def die():
            rig.action, rig.rate = DriveAction.RUN, 100.0
            await rig.settle(4.0)
            rig.port.device.faults.deaf = True
            await rig.settle(2.0)
            assert rig.turning() == pytest.approx(100.0, rel=0.03)

        async with background(die()) as dying:
            with pytest.raises(DeviceTimeoutError):
                await rig.session()
            await dying

    on_bench(test, ESC)


@pytest.mark.parametrize("fault", [("scaled", "1.1"), ("noisy", "40")])
def test_without_pulses_a_motor_stops_that_does_not_obey_neutral(fault: tuple[str, str]):
    async def test(rig):
        async def disobey():
            rig.action, rig.rate = DriveAction.RUN, 100.0
            await rig.settle(4.0)
            rig.emulator.signals.inject(f"target_{ESC.esc.channel}", *fault)
            rig.action = DriveAction.QUICK_STOP
            await rig.settle(0.3)
            assert rig.pulse(ESC.esc.channel) is None

        async with background(disobey()) as disobeying:
            with pytest.raises(DeviceFaultError, match=r"channels \[\d\] do not come to rest: all pulses are off"):
                await rig.session()
            await disobeying

    on_bench(test, ESC)


def test_a_chip_that_sleeps_is_woken_only_once_its_motor_has_come_to_rest():
    async def test(rig):
        pulses = set()

        async def watch():
            while True:
                pulses.add(rig.pulse(MOTOR))
                await rig.settle(0.001)

        rig.emulator.signals.inject(f"target_{MOTOR}", "noisy", "40")
        async with background(watch()):
            for _ in range(3):
                with pytest.raises(DeviceFaultError, match="do not come to rest"):
                    await rig.session()
        assert pulses == {None}
        rig.emulator.signals.inject(f"target_{MOTOR}", "off")
        async with rig.driving():
            await rig.settle(0.2)
            assert rig.pulse(MOTOR) == pytest.approx(1500, abs=3)

    on_bench(test, ESC)


def test_another_device_may_not_steer():
    async def test(rig):
        ends = {**rig.ends, "steering": None}
        with pytest.raises(ConfigError, match="another device steers"):
            Pca9685EscDriver(Pca9685EscConfig(), rig.port, rig.clock, **ends, battery=None, events=rig.events)

    on_bench(test, ESC)


def test_the_emulated_kinds_take_their_settings():
    from monstertruck_drivers.catalog import DEVICES
    from monstertruck_drivers.emulation import EmulatorSetup
    from monstertruck_runtime.clock import run_virtual
    from monstertruck_sim.world.config import WorldConfig
    from monstertruck_sim.world.world import World

    async def main(clock):
        world = World(WorldConfig(), 0)
        for kind, settings in (("pca9685", Pca9685Config(address=0x55)), ("pca9685_esc", None)):
            setup = EmulatorSetup("steering", settings, clock, world)
            emulator = DEVICES[kind].emulated(setup)
            assert isinstance(emulator, Pca9685Emulator)
            assert emulator.address == (0x40 if settings is None else 0x55)
        assert math.isfinite(emulator.oscillator)

    run_virtual(main, start=SECOND)
