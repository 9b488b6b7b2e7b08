"""The emulated sensor seen through a plain terminal: one test for each thing it must reproduce."""

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_drivers.cable import MemoryPort, PtyPort
from monstertruck_drivers.hokuyo_urg.emulator import parse_order, parse_scip1_order
from monstertruck_drivers.hokuyo_urg.protocol import (
    Reply,
    ScipParser,
    decode_counter,
    decode_scan,
    parse_fields,
    sum_matches,
)
from monstertruck_drivers.link import Link
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual, run_wall
from monstertruck_runtime.errors import DeviceLostError, InputError, ProtocolError
from tests.unit.drivers.hokuyo_urg.rig import Pattern, Rig, bench, talk
from tests.unit.drivers.kit import read_until

MD = "MD0044072501000"


def ask(*lines: str, wait: float = 0.05, **kwargs: Any) -> bytes:
    """Everything a sensor that starts in SCIP 2.0 (unless stated otherwise) says to ``lines``."""

    async def main(clock: VirtualClock) -> bytes:
        async with bench(clock, **{"state": "scip2", **kwargs}) as rig:
            assert isinstance(rig.port, MemoryPort)
            return await talk(rig.port, clock, *lines, wait=wait)

    return run_virtual(main)


def on_bench(play: Callable[[Rig, MemoryPort, VirtualClock], Coroutine[Any, Any, Any]], **kwargs: Any) -> Any:
    async def main(clock: VirtualClock) -> Any:
        async with bench(clock, **{"state": "scip2", **kwargs}) as rig:
            assert isinstance(rig.port, MemoryPort)
            return await play(rig, rig.port, clock)

    return run_virtual(main)


def replies(heard: bytes) -> list[Reply]:
    return ScipParser().feed(heard)


# Power-up and dialects


def test_power_up_in_scip1():
    assert ask("QT", "VV", state="scip1") == b"QT\nE\n\nVV\nE\n\n"


def test_scip1_version_has_no_sums():
    heard = ask("V", state="scip1")
    assert heard.startswith(b"V\n0\nVEND:Hokuyo Automatic Co.,Ltd.;\nPROD:SOKUIKI Sensor URG-04LX;\n")
    assert heard.endswith(b"SERI:H0706400;\n\n")


def test_switch_to_scip2():
    assert ask("SCIP2.0", "QT", state="scip1") == b"SCIP2.0\n0\n\nQT\n00P\n\n"


def test_an_old_unit_cannot_switch():
    assert ask("SCIP2.0", "QT", state="scip1", firmware="2.2.5") == b"SCIP2.0\nE\n\nQT\nE\n\n"


def test_scip1_scan_needs_the_laser_and_has_no_sums():
    heard = ask("G00076801", "L1", "G00076801", "L0", state="scip1", wait=0.3)
    dark, on, scan, off = replies(heard)
    assert (dark.status, on.status, off.status) == ("E", "0", "0")
    assert [len(line) for line in scan.lines] == [64] * 24 + [2]
    assert decode_scan(scan, 0, 768).values[0] == 501


@pytest.mark.parametrize("line", ["G0007680", "Gaaabbbcc", "G70060001", "G00090001", "S0192000000000", "X"])
def test_scip1_refusals(line: str):
    assert ask("L1", line, state="scip1").endswith(f"{line}\nE\n\n".encode())


def test_scip1_accepts_carriage_returns():
    assert ask("L1\rL0\r", state="scip1") == b"L1\n0\n\nL0\n0\n\n"


def test_scip2_string_in_scip2_is_an_error_reply():
    assert ask("SCIP2.0") == b"SCIP2.0\n0Ee\n\n"


def test_power_cycle_returns_to_scip1_or_stays_as_configured():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        await talk(port, clock, MD)
        rig.emulator.power_cycle()
        return await talk(port, clock, "QT", wait=0.3)

    assert on_bench(play, state="scip2") == b"QT\n00P\n\n"
    assert on_bench(play, state="streaming") == b"QT\nE\n\n"


# Framing


def test_every_request_is_echoed_with_its_string():
    assert ask("QT;hello truck") == b"QT;hello truck\n00P\n\n"
    assert ask("QT;seventeen letters") == b"QT;seventeen letters\n00P\n\n"[:21] + b"0Gg\n\n"


def test_captured_identity_and_parameters():
    heard = ask("VV", "PP")
    assert b"VEND:Hokuyo Automatic Co.,Ltd.;[\nPROD:SOKUIKI Sensor URG-04LX;[\n" in heard
    assert b"FIRM:3.1.04(02/Aug./2007);a\nPROT:SCIP 2.0;N\nSERI:H0706400;F\n\n" in heard
    assert heard.endswith(
        b"PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\nARES:1024;\\\n"
        b"AMIN:44;7\nAMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
    )


def test_state_tells_laser_and_counter():
    dark, _, lit = replies(ask("II", "BM", "II", timer_start=0x6A5404))
    assert parse_fields(dark.lines)["LASR"] == "OFF"
    assert int(parse_fields(dark.lines)["TIME"], 16) == 0x6A5404
    assert parse_fields(lit.lines)["LASR"] == "ON"
    assert parse_fields(lit.lines)["MESM"] == "CLASSIC"


def test_data_lines_hold_64_characters_and_split_samples():
    (_, reply) = replies(ask("BM", "GD0044072501", wait=0.2))
    assert [len(line) for line in reply.lines] == [5] + [65] * 31 + [63]
    assert all(sum_matches(line) for line in reply.lines)


# Scans


def test_single_scan_needs_the_laser():
    heard = ask("GD0044072501", "BM", "BM", "GD0044072501", "GS0044072501", wait=0.2)
    statuses = [(reply.echo[:2], reply.status) for reply in replies(heard)]
    assert statuses == [("GD", "10"), ("BM", "00"), ("BM", "02"), ("GD", "00"), ("GS", "00")]


def test_counted_stream_counts_down_and_turns_the_laser_off():
    heard = ask("MD0044004801003;tag", "II", wait=0.6)
    *stream, state = replies(heard)
    assert [reply.status for reply in stream] == ["00", "99", "99", "99"]
    assert [reply.echo for reply in stream] == [f"MD00440048010{left:02d};tag" for left in (3, 2, 1, 0)]
    counters = [decode_counter(reply.lines[0]) for reply in stream[1:]]
    assert np.diff(counters).tolist() == [100, 100]
    assert parse_fields(state.lines)["LASR"] == "OFF"


def test_scans_come_after_their_revolution():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> None:
        async with await port.open() as link:
            link.write(f"{MD}\n".encode())
            await read_until(link, b"\n\n")
            for _ in range(5):
                await read_until(link, b"\n\n")
                age = clock.now() - rig.emulator._source.times[-1]
                assert 0.0708 * SECOND < age < 0.08 * SECOND

    on_bench(play)


def test_skip_and_cluster():
    heard = ask("MS0044004803103", wait=0.8)
    blocks = [decode_scan(reply, 44, 48, 3) for reply in replies(heard)[1:]]
    assert np.diff([block.counter for block in blocks]).tolist() == [200, 200]
    assert blocks[0].values.tolist() == [500 + 44 * 5 + 1, 500 + 47 * 5 + 1]


def test_a_cluster_reports_its_least_valid_value_or_a_code():
    (_, reply) = replies(ask("BM", "GD0096010710", wait=0.2))
    assert decode_scan(reply, 96, 107, 10).values.tolist() == [981, 6]


def test_error_codes_are_sent_as_they_are():
    (_, reply) = replies(ask("BM", "GD0100011901", wait=0.2))
    assert decode_scan(reply, 100, 119).values.tolist() == list(range(20))


def test_short_words_are_saturated():
    class Far:
        def scan(self, time_ns: int) -> np.ndarray:
            return np.full(769, 5000, np.int32)

    (_, long, short) = replies(ask("BM", "GD0100010001", "GS0100010001", wait=0.2, source=Far()))
    assert decode_scan(long, 100, 100).values.tolist() == [5000]
    assert decode_scan(short, 100, 100).values.tolist() == [4095]


def test_streaming_survives_a_closed_client():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        await talk(port, clock, MD, wait=0.3)
        await clock.sleep(60)
        async with await port.open() as link:
            return (await read_until(link, b"\n"))[:-1]

    assert on_bench(play) == MD.encode()


def test_started_streaming():
    heard = ask("", state="streaming", wait=0.5)
    assert 4 <= len(replies(heard)) <= 5
    assert {reply.echo for reply in replies(heard)} == {MD}


def test_other_commands_are_answered_between_blocks():
    found = replies(ask(MD, "VV", "QT", wait=0.35))
    assert [reply.echo[:2] for reply in found].count("VV") == 1
    assert found[-1].echo == "QT"


# Refusals


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("XX", "0E"),
        ("VVx", "0E"),
        ("HS1", "0E"),
        ("CR00", "03"),
        ("CR05", "04"),
        ("TM5", "01"),
        ("MD", "0C"),
        ("MD00440725010000", "0D"),
        ("MDx044072501000", "01"),
        ("MD0044x72501000", "02"),
        ("MD00440725x1000", "03"),
        ("MD0044072501x00", "06"),
        ("MD00440725010x0", "07"),
        ("MD0044076901000", "04"),
        ("MS0725004401000", "05"),
        ("GDx044072501", "01"),
        ("GD0044072", "0C"),
        ("SS0192", "0C"),
        ("SS01920x", "01"),
        ("SS009600", "02"),
        ("SS019200", "03"),
        ("SS115200", "00"),
    ],
)
def test_statuses(line: str, status: str):
    (reply,) = replies(ask(line))
    assert (reply.echo, reply.status) == (line, status)


def test_a_repeated_command_gets_one_answer_and_a_refusal():
    assert ask("QT\nQT") == b"QT\n00P\n\nQT\n0Bb\n\n"


def test_a_second_stream_is_refused():
    assert b"MD0044072502000\n0Bb\n\n" in ask(MD, "MD0044072502000")


def test_orders_are_parsed_for_both_dialects():
    assert parse_order("GD0001000203") == parse_order("GD0001000203", "")
    order = parse_scip1_order("G00100203")
    assert order is not None
    assert (order.start, order.end, order.cluster) == (1, 2, 3)


# Time


def test_time_adjust_mode():
    heard = ask("TM1", "TM0", "TM0", "TM1", "QT", "TM2", "TM2", "QT", wait=0.01, timer_start=1000)
    found = replies(heard)
    assert [reply.status for reply in found] == ["04", "00", "02", "00", "0E", "00", "03", "00"]
    assert 1000 <= decode_counter(found[3].lines[0]) < 1100


def test_time_adjust_mode_can_be_found_on_opening():
    assert ask("QT", "RS", "QT", state="time_adjust") == b"QT\n0Ee\n\nRS\n00P\n\nQT\n00P\n\n"


def test_time_adjust_is_refused_while_scanning():
    found = replies(ask(MD, "TM0", "TM1"))
    assert [reply.status for reply in found if reply.echo[:2] == "TM"] == ["0A", "04"]


def test_counter_wraps():
    stream = replies(ask("MD0044004801005", wait=0.8, timer_start=(1 << 24) - 250))[1:]
    counters = [decode_counter(reply.lines[0]) for reply in stream]
    assert max(counters) - min(counters) > 1 << 23
    assert {(b - a) & 0xFFFFFF for a, b in pairwise(counters)} == {100}


def test_reset_zeroes_the_counter_and_ends_the_stream():
    found = replies(ask("RS", "II", timer_start=500_000))
    assert int(parse_fields(found[1].lines)["TIME"], 16) < 100
    assert replies(ask(MD, "RS", wait=0.3))[-1].echo == "RS"


@pytest.mark.parametrize("drift_ppm", [-200.0, 200.0])
def test_its_clock_drifts(drift_ppm: float):
    async def play(_: Rig, port: MemoryPort, clock: VirtualClock) -> tuple[int, int]:
        first = replies(await talk(port, clock, "TM0", "TM1"))[1]
        await clock.sleep(1000)
        last = replies(await talk(port, clock, "TM1"))[0]
        return decode_counter(first.lines[0]), decode_counter(last.lines[0])

    a, b = on_bench(play, drift_ppm=drift_ppm)
    assert b - a - 1_000_050 == pytest.approx(drift_ppm, abs=2)


def test_batching_delays_scans_but_keeps_their_order():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> tuple[list[int], list[int]]:
        ages, counters = [], []
        async with await port.open() as link:
            link.write(f"{MD}\n".encode())
            await read_until(link, b"\n\n")
            for _ in range(50):
                block = await read_until(link, b"\n\n")
                ages.append((clock.now() - rig.emulator._source.times[-1]) // 1_000_000)
                counters.append(decode_counter(replies(block)[0].lines[0]))
        return ages, counters

    ages, counters = on_bench(play, jitter=0.2, seed=5)
    assert max(ages) > 150
    assert min(ages) < 120
    assert np.all(np.diff(counters) == 100)


def test_after_the_host_machine_slept_old_revolutions_are_lost():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> int:
        await talk(port, clock, MD, wait=0.3)
        before = len(rig.emulator._source.times)
        rig.emulator._born -= 100 * SECOND  # its own time went on by as much
        await clock.sleep(1)
        return len(rig.emulator._source.times) - before

    assert 8 <= on_bench(play) <= 12


# Faults


def test_statuses_of_a_stream():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> list[str]:
        async with await port.open() as link:
            link.write(f"{MD}\n".encode())
            for code, wait in (("21", 0.5), ("98", 0.25), ("50", 0.5)):
                await clock.sleep(0.25)
                rig.emulator.inject("status", code)
                await clock.sleep(wait)
            return [reply.status for reply in replies(await link.read())]

    statuses = on_bench(play)
    assert statuses[0] == "00"
    assert [status for status in statuses[1:] if status != "99"] == ["21", "98", "50"]
    assert statuses[statuses.index("21") + 1] == "98"
    assert statuses[-1] == "50"
    assert "99" in statuses[statuses.index("98") :]


def test_a_broken_laser():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        rig.emulator.inject("laser")
        return await talk(port, clock, "BM", "II", MD, wait=0.3)

    heard = on_bench(play)
    assert heard.startswith(b"BM\n01Q\n\n")
    assert b"STAT:Laser malfunction.;" in heard
    assert [reply.status for reply in replies(heard)[2:]] == ["00", "50"]
    assert on_bench(play, state="scip1").startswith(b"BM\nE\n\n")


def test_the_seri_quirk():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        rig.emulator.inject("seri")
        return await talk(port, clock, "VV")

    heard = on_bench(play)
    assert b"\n\nFIRM" in heard
    assert b"SERI:H0706400;G\n\n" in heard


def test_deafness_after_an_unknown_command_lasts_until_power_is_cycled():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> tuple[bytes, bytes]:
        rig.emulator.inject("fragile")
        deaf = await talk(port, clock, "QT", "%ST", "QT", "VV")
        rig.emulator.power_cycle()
        return deaf, await talk(port, clock, "QT")

    assert on_bench(play) == (b"QT\n00P\n\n", b"QT\n00P\n\n")


def test_deafness_can_end():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        rig.emulator.inject("deaf", "on")
        assert await talk(port, clock, "QT") == b""
        rig.emulator.inject("deaf", "off")
        return await talk(port, clock, "QT")

    assert on_bench(play) == b"QT\n00P\n\n"


def test_a_block_cut_within_a_line():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        rig.emulator.inject("cut")
        return await talk(port, clock, MD, wait=0.35)

    heard = on_bench(play)
    _, _, first, *_ = heard.split(MD.encode() + b"\n")
    _, cut, whole = replies(heard)[:3]
    assert not first.endswith(b"\n")
    with pytest.raises(ProtocolError):
        decode_scan(cut, 44, 725)
    assert len(decode_scan(whole, 44, 725).values) == 682


def test_bytes_lost_and_flipped_on_the_line():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        port.device.faults.drop_rate = port.device.faults.flip_rate = 0.01
        port.device.faults.seed(1)
        return await talk(port, clock, "BM", "GD0044072501", wait=0.2)

    assert on_bench(play) != ask("BM", "GD0044072501", wait=0.2)


def test_a_closed_pty_is_an_unplugged_sensor(tmp_path: Path):
    async def main(clock: Any) -> None:
        port = PtyPort(tmp_path / "lidar")
        async with bench(clock, state="scip2", port=port):
            link: Link = await SerialPort(tmp_path / "lidar").open()
            async with link:
                link.write(b"QT\n")
                async with asyncio.timeout(2):
                    assert await read_until(link, b"\n\n") == b"QT\n00P\n\n"
                    port.unplug()
                    with pytest.raises(DeviceLostError):
                        await link.read()

    run_wall(main)


@pytest.mark.parametrize(
    "fault", [("nothing",), ("status",), ("status", "20"), ("status", "x"), ("deaf", "maybe"), ("cut", "x"), ("timer",)]
)
def test_unknown_faults_are_refused(fault: tuple[str, ...]):
    async def play(rig: Rig, _port: MemoryPort, _clock: VirtualClock) -> None:
        with pytest.raises(InputError, match="known: status"):
            rig.emulator.inject(*fault)

    on_bench(play)


def test_requests_are_logged():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> list[str]:
        await talk(port, clock, "QT;x", "XX", "")
        return list(rig.emulator.received)

    assert on_bench(play) == ["QT;x", "XX"]


def test_rate_of_a_serial_line_follows_ss_and_rs():
    async def play(_rig: Rig, port: MemoryPort, clock: VirtualClock) -> list[int | None]:
        port.device.baud = 19200
        rates = [port.device.baud]
        for line in ("SS115200", "RS"):
            await talk(port, clock, line)
            rates.append(port.device.baud)
        return rates

    assert on_bench(play) == [19200, 115200, 19200]


def test_requests_waiting_at_power_loss_are_forgotten():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> bytes:
        async with await port.open() as link:
            link.write(b"QT\nVV\nPP\n")
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            rig.emulator.power_cycle()
            heard = b""
            with contextlib.suppress(TimeoutError):
                async with clock.deadline(0.1):
                    while True:
                        heard += await link.read()
            return heard

    assert b"PP" not in on_bench(play)


def test_the_source_is_asked_only_for_what_is_sent():
    async def play(rig: Rig, port: MemoryPort, clock: VirtualClock) -> int:
        await clock.sleep(10)
        await talk(port, clock, "MD0044072501002", wait=0.5)
        source = rig.emulator._source
        assert isinstance(source, Pattern)
        return len(source.times)

    assert on_bench(play) == 2
