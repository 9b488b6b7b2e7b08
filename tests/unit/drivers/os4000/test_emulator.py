"""The emulated compass behaves as the manual says."""

import contextlib

import pytest

from monstertruck_drivers.link import Link
from monstertruck_drivers.os4000.emulator import Os4000Emulator
from monstertruck_drivers.os4000.protocol import Fields, Key, Os4000Parser, Sentence, key, value
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from tests.unit.drivers.os4000.rig import Rig, Table, bench


class Terminal:
    """A host that talks by hand."""

    def __init__(self, rig: Rig, link: Link) -> None:
        self.rig = rig
        self.link = link
        self.parser = Os4000Parser()

    async def hear(self, seconds: float) -> list[Sentence]:
        return self.parser.feed(await self.raw(seconds))

    async def raw(self, seconds: float) -> bytes:
        heard = b""
        with contextlib.suppress(TimeoutError):
            async with self.rig.clock.deadline(seconds):
                while True:
                    heard += await self.link.read()
        return heard


def on_terminal(test, **options):
    """Run ``test(terminal)`` on the virtual clock; the unit has booted and its torn first sentence is gone."""

    async def main(clock: VirtualClock) -> None:
        async with bench(clock, **options) as rig:
            await clock.sleep(0.5)
            async with await rig.port.open() as link:
                await test(Terminal(rig, link))

    run_virtual(main)


def test_it_streams_unasked_at_its_rate_and_quantises():
    async def test(t: Terminal) -> None:
        heard = await t.hear(2.01)
        assert len(heard) == pytest.approx(40, abs=1)
        assert heard[0].fields == Fields(335)
        assert (heard[0].heading, heard[0].pitch, heard[0].roll, heard[0].temperature) == (123.4, 5.0, -7.0, 21.5)
        assert heard[0].field == pytest.approx((-140, 210, -390), abs=2)
        assert len({s.field for s in heard}) > 10, "a live sensor is never quite still"

    on_terminal(test)


def test_heading_wraps_and_never_says_360():
    async def test(t: Terminal) -> None:
        for heading, shown in ((359.94, 359.9), (359.96, 0.0), (0.04, 0.0)):
            t.rig.table.turn(heading_deg=heading)
            await t.hear(0.2)
            assert (await t.hear(0.1))[-1].heading == shown

    on_terminal(test)


def test_negative_zero_is_printed_as_zero():
    async def test(t: Terminal) -> None:
        t.rig.table.turn(pitch_deg=-0.01, roll_deg=-0.04)
        await t.hear(0.2)
        assert b"P0.0R0.0" in await t.raw(0.2)

    on_terminal(test)


@pytest.mark.parametrize(
    ("command", "number", "check"),
    [
        (Key.RATE, 5, lambda s: s.rate == 5),
        (Key.RATE, -100, lambda s: s.rate == -100),
        (Key.RATE, 41, lambda s: s.rate == 20),
        (Key.FIELDS, 7, lambda s: s.fields == 7),
        (Key.FIELDS, 512, lambda s: s.fields == 335),
        (Key.MOUNTING, 3, lambda s: s.mounting == 3),
        (Key.MOUNTING, 7, lambda s: s.mounting == 1),
        (Key.FACTORY_BAUD, 6, lambda s: s.baud == 6),
        (Key.FORMAT, 3, lambda s: s.format == 1),
        (Key.TEMPERATURE_OFFSET, -2, lambda s: s.temperature_offset == -2),
    ],
)
def test_settings_are_checked_and_kept_over_a_power_cycle(command: Key, number: int, check):
    async def test(t: Terminal) -> None:
        t.link.write(key(command) + value(number))
        await t.hear(0.1)
        t.rig.emulator.power_cycle()
        assert check(t.rig.emulator.settings)

    on_terminal(test)


def test_a_setting_acts_after_a_pause():
    async def test(t: Terminal) -> None:
        t.link.write(key(Key.FIELDS) + value(7))
        assert len(await t.hear(0.7)) <= 1, "at most what was on the wire"
        heard = await t.hear(1.0)
        assert heard
        assert all(s.fields == Fields(7) for s in heard)

    on_terminal(test)


def test_the_stream_waits_inside_a_command_and_prompts_hold_no_dollar():
    async def test(t: Terminal) -> None:
        t.link.write(key(Key.RATE))
        raw = await t.raw(3)
        assert raw.count(b"$") <= 1
        assert b"CMD R" in raw
        t.link.write(b"\x1b")
        assert await t.hear(0.3)
        assert t.rig.emulator.settings.rate == 20
        t.link.write(b"\x1b")
        await t.hear(0.1)
        assert not await t.hear(1)
        t.link.write(b"?")
        assert await t.hear(0.3), "an unknown key ends it"

    on_terminal(test)


@pytest.mark.parametrize("typed", [b"\x1bR5 ", b"\x1bR5\r", b"\x1bR\x08x5\r"])
def test_space_and_enter_end_a_value_and_strange_keys_are_skipped(typed: bytes):
    async def test(t: Terminal) -> None:
        t.link.write(typed)
        await t.hear(0.1)
        assert t.rig.emulator.settings.rate == 5

    on_terminal(test)


def test_a_firmware_may_take_one_end_of_value_only():
    async def test(t: Terminal) -> None:
        t.link.write(b"\x1bR5 ")
        await t.hear(0.1)
        assert t.rig.emulator.settings.rate == 20
        t.link.write(b"\r")
        await t.hear(0.1)
        assert t.rig.emulator.settings.rate == 5

    on_terminal(test, terminators=b"\r")


def test_no_value_is_invalid():
    async def test(t: Terminal) -> None:
        t.link.write(b"\x1bR ")
        assert b"Invalid" in await t.raw(0.2)
        assert t.rig.emulator.settings.rate == 20

    on_terminal(test)


def test_version_configuration_and_calibration_talk():
    async def test(t: Terminal) -> None:
        t.link.write(key(Key.VERSION))
        assert b"Ver" in await t.raw(0.2)
        t.link.write(key(Key.CONFIGURATION))
        assert b"Baud 19200" in await t.raw(0.2)
        t.link.write(key(Key.CALIBRATE_LEVEL))
        assert b"CMD C" in await t.raw(0.2)
        assert await t.raw(2) == b""
        t.link.write(b"\r")
        assert await t.hear(1.0)
        t.link.write(b"AT\r\n")
        assert await t.hear(0.2), "text without ESC is nothing to it"

    on_terminal(test)


def test_rate_zero_is_silence_also_after_a_power_cycle():
    async def test(t: Terminal) -> None:
        t.link.write(key(Key.RATE) + value(0))
        await t.raw(0.3)
        assert await t.raw(3) == b""
        t.rig.port.unplug()
        t.rig.port.plug()
        async with await t.rig.port.open() as t.link:
            assert await t.raw(3) == b""
            t.link.write(key(Key.RATE) + value(10))
            assert await t.hear(2)

    on_terminal(test)


def test_slow_rates():
    async def test(t: Terminal) -> None:
        assert len(await t.hear(10.5)) in (4, 5, 6)

    on_terminal(test, rate=-2)


def test_a_new_baud_rate_acts_from_the_next_power_up_on():
    async def test(t: Terminal) -> None:
        t.link.write(key(Key.FACTORY_BAUD) + value(4))
        await t.hear(1.5)
        assert t.rig.port.device.baud == 19200
        t.rig.emulator.power_cycle()
        assert t.rig.port.device.baud == 38400
        t.rig.emulator.host_baud = 19200
        await t.raw(0.3)
        raw = await t.raw(1)
        assert raw
        assert b"$" not in raw, "at the wrong rate there is only noise"
        t.link.write(key(Key.RATE) + value(1))
        await t.raw(0.2)
        assert t.rig.emulator.settings.rate == 20, "and it does not understand either"

    on_terminal(test)


def test_the_line_carries_no_more_than_its_baud_rate():
    async def test(t: Terminal) -> None:
        raw = await t.raw(5)
        assert len(raw) <= 1920 * 5 + 100
        assert len(t.parser.feed(raw)) < 35 * 5

    on_terminal(test, rate=40)


def test_after_plugging_in_the_first_sentence_is_torn():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig, await rig.port.open() as link:
            raw = await Terminal(rig, link).raw(0.4)
            assert raw
            assert not raw.startswith(b"$")
            assert b"\n$" in raw

    run_virtual(main)


def test_formats_other_than_tagged():
    async def test(t: Terminal) -> None:
        for number, start in ((2, b"$OHPR,"), (4, b"$HCHDT,"), (8, b"123.4,")):
            t.rig.emulator.inject("format", str(number))
            await t.raw(0.2)
            assert start in await t.raw(0.2)

    on_terminal(test)


# Faults


def test_frozen_value():
    async def test(t: Terminal) -> None:
        t.rig.emulator.inject("frozen", "on")
        await t.hear(0.2)
        t.rig.table.turn(heading_deg=10.0)
        heard = await t.hear(2)
        assert len(heard) > 30
        assert len(set(heard)) == 1
        t.rig.emulator.inject("frozen", "off")
        await t.hear(0.2)
        assert (await t.hear(0.2))[-1].heading == 10.0

    on_terminal(test)


def test_bad_checksums_torn_sentences_and_prompts():
    async def test(t: Terminal) -> None:
        t.rig.emulator.inject("bad_checksum", "3")
        await t.hear(0.5)
        assert t.parser.bad == 3
        t.rig.emulator.inject("prompt")
        t.rig.emulator.inject("half_sentence")
        await t.hear(0.5)
        assert any(b"CMD" in line for line in t.parser.text)
        assert t.parser.bad == 3

    on_terminal(test)


@pytest.mark.parametrize("fault", ["empty_field", "nan_field"])
def test_fields_without_a_number(fault: str):
    async def test(t: Terminal) -> None:
        t.rig.emulator.inject(fault, "P")
        await t.hear(0.2)
        heard = (await t.hear(0.3))[-1]
        assert (heard.heading, heard.pitch, heard.roll) == (123.4, None, -7.0)
        t.rig.emulator.inject(fault, "D")
        await t.hear(0.2)
        assert (await t.hear(0.3))[-1].pitch == 5.0, "a field that is not sent cannot be spoiled"
        t.rig.emulator.inject(fault, "none")

    on_terminal(test)


def test_disturbance_drift_silence_and_pending():
    async def test(t: Terminal) -> None:
        t.rig.emulator.inject("disturbance", "-130")
        await t.hear(0.2)
        assert (await t.hear(0.2))[-1].heading == 353.4
        t.rig.emulator.inject("drift", "-0.5")
        assert len(await t.hear(4)) == pytest.approx(40, abs=2)
        t.rig.emulator.inject("pending")
        await t.hear(0.2)
        assert await t.raw(2) == b""
        t.link.write(b"\r")
        assert await t.hear(2)
        t.rig.emulator.inject("silent", "on")
        await t.raw(0.2)
        assert await t.raw(2) == b""

    on_terminal(test)


@pytest.mark.parametrize("fault", [("nonsense",), ("nonsense", "1"), ("rate", "99"), ("drift", "x"), ("frozen",)])
def test_unknown_faults_are_refused_with_the_list_of_known_ones(fault: tuple[str, ...]):
    async def main(clock: VirtualClock) -> None:
        with pytest.raises(InputError, match="bad_checksum N"):
            Os4000Emulator(clock, Table()).inject(*fault)

    run_virtual(main)


def test_two_runs_of_one_seed_are_equal_and_another_seed_differs():
    def run(seed: int) -> bytes:
        async def main(clock: VirtualClock) -> bytes:
            async with bench(clock, seed=seed) as rig, await rig.port.open() as link:
                return await Terminal(rig, link).raw(2)

        return run_virtual(main)

    assert run(1) == run(1)
    assert run(1) != run(2)
