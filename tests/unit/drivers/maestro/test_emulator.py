"""The emulated servo controller behaves as the manual says."""

import asyncio
import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.link import Link
from monstertruck_drivers.maestro.emulator import MaestroEmulator, Ramp
from monstertruck_drivers.maestro.protocol import Encoder, Error, words
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceLostError, InputError
from tests.unit.drivers.kit import background

E = Encoder()


class Bench:
    """A bare emulator and a host that talks by hand."""

    def __init__(self, clock: VirtualClock, **options: object) -> None:
        self.clock = clock
        self.port = MemoryPort("/dev/test")
        self.outputs: list[tuple[int, bool, int]] = []
        self.emulator = MaestroEmulator(clock, usb=self.port, on_output=self._changed, **options)  # type: ignore[arg-type]
        self.link: Link | None = None

    def _changed(self, channel: int, high: bool) -> None:
        self.outputs.append((channel, high, self.clock.now()))

    async def ask(self, *requests: bytes) -> bytes:
        assert self.link is not None
        self.link.write(b"".join(requests))
        await asyncio.sleep(0)
        await self.clock.sleep(0.001)
        with contextlib.suppress(TimeoutError):
            async with self.clock.deadline(0.001):
                return await self.link.read()
        return b""

    async def errors(self) -> int:
        return words(await self.ask(E.get_errors()))[0]

    async def position(self, channel: int) -> int:
        return words(await self.ask(E.get_position(channel)))[0]


def on_bench(test, **options):
    """Run ``test(bench)`` on the virtual clock, port open, power-up errors cleared."""

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, **options)
        bench.port.plug()
        async with background(bench.emulator.run(bench.port.device)), await bench.port.open() as link:
            bench.link = link
            await bench.ask(E.get_errors())
            await test(bench)

    run_virtual(main)


def test_power_up_leaves_a_signal_error_pending_and_reading_clears():
    async def test(bench: Bench) -> None:
        bench.emulator.power_cycle()
        assert await bench.errors() == Error.SERIAL_SIGNAL
        assert await bench.errors() == 0

    on_bench(test)


def test_targets_are_clamped_and_zero_is_off():
    async def test(bench: Bench) -> None:
        for target, pulse in ((6000, 1500.0), (100, 992.0), (16000, 2000.0), (0, None)):
            await bench.ask(E.set_target(1, target))
            assert bench.emulator.pulse_us(1, bench.clock.now()) == pulse

    on_bench(test)


def test_speed_limits_the_ramp_and_position_is_the_pulse_being_sent():
    async def test(bench: Bench) -> None:
        await bench.ask(E.set_target(1, 5000), E.set_speed(1, 100))
        assert await bench.position(1) == 5000, "the first target after power-up cannot be ramped"
        await bench.ask(E.set_target(1, 7000))
        await bench.clock.sleep(0.1)
        assert await bench.position(1) == pytest.approx(6000, abs=101)
        await bench.clock.sleep(0.12)
        assert await bench.position(1) == 7000

    on_bench(test)


def test_acceleration_makes_the_ramp_start_slowly():
    async def test(bench: Bench) -> None:
        await bench.ask(E.set_target(1, 5000), E.set_acceleration(1, 8), E.set_target(1, 7000))
        await bench.clock.sleep(0.1)
        assert await bench.position(1) == pytest.approx(5055, abs=15)  # 1/2 a t^2 with 1 per tick^2
        await bench.clock.sleep(2)
        assert await bench.position(1) == 7000

    on_bench(test)


@given(
    st.lists(st.integers(3968, 8000), min_size=1, max_size=4),
    st.integers(0, 400),
    st.integers(0, 255),
    st.integers(0, 30),
)
@settings(max_examples=60)
def test_every_ramp_arrives_and_stays(targets: list[int], speed: int, acceleration: int, between: int):
    ramp = Ramp(speed=speed, acceleration=acceleration)
    ramp.aim(6000)
    for target in targets:
        ramp.aim(target)
        for _ in range(between):
            before = ramp.position
            ramp.step()
            assert not speed or abs(ramp.position - before) <= max(speed, acceleration / 4) + 1e-9
    steps = 0
    while (ramp.position, ramp.velocity) != (targets[-1], 0.0):
        ramp.step()
        steps += 1
        assert steps < 6000


@pytest.mark.parametrize(
    ("junk", "error"),
    [
        (b"\x05", Error.PROTOCOL),
        (bytes.fromhex("84 02 A1"), Error.PROTOCOL),
        (bytes.fromhex("8A 00 00 00 00"), Error.PROTOCOL),
        (bytes.fromhex("90 06"), Error.PROTOCOL),
    ],
)
def test_bad_bytes_set_errors_and_send_channels_home(junk: bytes, error: Error):
    async def test(bench: Bench) -> None:
        await bench.ask(*(E.set_target(channel, 7000) for channel in range(4)))
        answer = await bench.ask(junk)
        assert (words(answer)[0] if answer else await bench.errors()) == error
        pulses = [bench.emulator.pulse_us(channel, bench.clock.now()) for channel in range(4)]
        assert pulses == [1750.0, None, 1600.0, None]

    on_bench(test, home={0: "ignore", 1: "off", 2: 1600.0})


def test_crc_is_required_where_it_is_on():
    async def test(bench: Bench) -> None:
        secure = Encoder(crc=True)
        await bench.ask(secure.set_target(1, 6000)[:-1] + b"\x00")
        assert words(await bench.ask(secure.get_errors()))[0] & Error.CRC
        assert bench.emulator.pulse_us(1, bench.clock.now()) is None
        await bench.ask(secure.set_target(1, 6000))
        assert bench.emulator.pulse_us(1, bench.clock.now()) == 1500

    on_bench(test, crc=True)


def test_another_device_number_is_ignored():
    async def test(bench: Bench) -> None:
        assert await bench.ask(Encoder(device=13).get_errors()) == b""
        assert await bench.ask(Encoder(device=12).get_errors()) == b"\0\0"

    on_bench(test)


def test_the_rest_of_the_command_set():
    async def test(bench: Bench) -> None:
        assert await bench.ask(b"\x93") == b"\x00"
        assert await bench.ask(b"\xae") == b"\x01"
        await bench.ask(bytes.fromhex("FF 01 7F FF 09 7F"))
        assert await bench.position(1) == 6000
        await bench.ask(E.set_target(2, 7000), bytes.fromhex("A4 A7 00 A8 00 01 00 A2"))
        assert await bench.position(2) == 0
        assert await bench.errors() == 0

    on_bench(test)


def test_an_input_is_quantised_noisy_and_relative_to_the_rail():
    async def test(bench: Bench) -> None:
        bench.emulator.inject("battery", "25.2")
        bench.emulator.inject("noise", "0")
        assert await bench.position(5) == round(2.52 / 5 * 1023)
        bench.emulator.inject("rail", "4.8")
        assert await bench.position(5) == round(2.52 / 4.8 * 1023)
        await bench.ask(E.set_target(5, 6000))
        assert await bench.position(5) == round(2.52 / 4.8 * 1023), "a target at an input does nothing"
        bench.emulator.inject("noise", "1")
        assert len({await bench.position(5) for _ in range(20)}) > 2
        bench.emulator.inject("battery", "80")
        assert await bench.position(5) == 1023

    on_bench(test)


def test_the_rail_can_drift():
    async def test(bench: Bench) -> None:
        seen = set()
        for _ in range(6):
            seen.add(await bench.position(5))
            await bench.clock.sleep(10)
        assert max(seen) - min(seen) > 20

    on_bench(test, rail_drift_v=0.2, noise_lsb=0.0)


def test_the_serial_timeout_drops_an_output_although_nothing_is_sent():
    async def test(bench: Bench) -> None:
        await bench.ask(E.set_target(2, 8000))
        start = bench.clock.now()
        assert bench.outputs[-1][:2] == (2, True)
        for _ in range(5):  # any valid command feeds it
            await bench.clock.sleep(0.4)
            await bench.ask(E.get_position(1))
        fed = bench.clock.now()
        await bench.clock.sleep(2)
        channel, high, when = bench.outputs[-1]
        assert (channel, high) == (2, False)
        assert when > start + 2 * SECOND
        assert (when - fed) / SECOND == pytest.approx(0.5, abs=0.01)
        assert await bench.errors() == Error.SERIAL_TIMEOUT
        await bench.ask(E.set_target(2, 8000))
        await bench.clock.sleep(1)
        assert [level for _, level, _ in bench.outputs] == [True, False, True, False], "it fires again"

    on_bench(test, serial_timeout_s=0.5)


def test_uart_mode_ignores_the_command_port():
    async def test(bench: Bench) -> None:
        assert await bench.ask(E.get_errors()) == b""
        bench.emulator.inject("mode", "dual_port")
        assert await bench.ask(E.get_errors()) == b"\x01\x00"

    on_bench(test, mode="uart")


def test_unplugging_takes_the_supply():
    async def test(bench: Bench) -> None:
        await bench.ask(E.set_target(1, 6000), E.set_target(2, 8000))
        bench.port.unplug()
        await bench.clock.sleep(1)
        assert bench.emulator.pulse_us(1, bench.clock.now()) is None
        assert bench.outputs[-1][:2] == (2, False)
        bench.port.plug()
        assert bench.emulator.pulse_us(0, bench.clock.now()) == 1500, "home at power-up"

    on_bench(test, home={0: 1500.0}, serial_timeout_s=0.5)


def test_a_brown_out_makes_the_port_vanish_and_come_back_with_nothing_in_mind():
    async def test(bench: Bench) -> None:
        await bench.ask(E.set_target(1, 6000), E.set_speed(1, 7))
        bench.emulator.inject("brown_out", "0.3")
        with pytest.raises(DeviceLostError):
            await bench.ask(E.get_errors())
        await bench.clock.sleep(0.4)
        async with await bench.port.open() as bench.link:
            assert await bench.errors() == Error.SERIAL_SIGNAL
            assert await bench.position(1) == 0

    on_bench(test)


def test_a_brown_out_without_a_port_is_a_power_cycle():
    async def test(bench: Bench) -> None:
        await bench.ask(E.set_target(1, 6000))
        bench.emulator.usb = None
        bench.emulator.inject("brown_out")
        assert await bench.position(1) == 0

    on_bench(test)


def test_modem_commands_are_protocol_errors():
    async def test(bench: Bench) -> None:
        bench.emulator.inject("at_junk")
        assert await bench.errors() == Error.PROTOCOL
        bench.emulator.inject("error", "6")
        assert await bench.errors() == Error.SCRIPT_STACK
        bench.emulator.inject("mute", "on")
        assert await bench.ask(E.get_errors()) == b""

    on_bench(test)


@pytest.mark.parametrize(
    "fault", [("nonsense",), ("rail", "x"), ("mode", "usb"), ("error", "-1"), ("brown_out", "1", "2")]
)
def test_unknown_faults_are_refused_with_the_list_of_known_ones(fault: tuple[str, ...]):
    def make(clock: VirtualClock):
        async def main() -> None:
            with pytest.raises(InputError, match="brown_out"):
                MaestroEmulator(clock).inject(*fault)

        return main()

    run_virtual(make)


class Plant:
    """Servo plant that notes what it was asked, in order."""

    def __init__(self) -> None:
        self.log: list[tuple[str, float | None]] = []
        self.pulses: MaestroEmulator | None = None

    def attach(self, pulses: MaestroEmulator) -> None:
        self.pulses = pulses

    def advance(self, time_ns: int) -> None:
        assert self.pulses is not None
        self.log.append(("advance", self.pulses.pulse_us(1, time_ns)))

    def analog_volts(self, channel: int, time_ns: int) -> float:
        return 2.5 if channel == 5 else 0.0


def test_the_plant_follows_the_old_target_before_a_new_one_counts():
    plant = Plant()

    async def test(bench: Bench) -> None:
        await bench.ask(E.set_target(1, 6000))
        await bench.ask(E.set_target(1, 7000))
        await bench.ask(E.get_errors())
        assert [pulse for _, pulse in plant.log[-3:]] == [None, 1500.0, 1750.0]
        assert await bench.position(5) == pytest.approx(511, abs=4)

    on_bench(test, servos=plant)
