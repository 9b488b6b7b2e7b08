"""Byte fuzzer for every parser: no exception, bounded buffers, synchronised again within two frames.

    python benchmarks/fuzz.py [--bytes 10000000] [--seed 1] [PARSER ...]

Each parser receives noise and its own frames with flipped bits, lost, doubled and truncated bytes, in pieces of any
size. Valid frames follow every 64 kB: the number of lost ones measures the resynchronisation.
"""

import argparse
import asyncio
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from monstertruck_drivers.ax12 import protocol as ax12
from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos import protocol as epos
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.epos.exchange import Exchanger
from monstertruck_drivers.hokuyo_urg import protocol as scip
from monstertruck_drivers.maestro import protocol as maestro
from monstertruck_drivers.os4000 import protocol as os4000
from monstertruck_drivers.webcam import driver as webcam_driver
from monstertruck_drivers.webcam import packets
from monstertruck_runtime import wire
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceTimeoutError, InputError, ProtocolError
from monstertruck_schemas import topics
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.sensor import DriveFeedback, DriveMode, LaserScan

ROUND = 65536
FRAMES = 64
"""Correct ones after every round."""
IN_STEP = 2
"""Frames that may be lost."""
HELD_LIMIT = 1 << 20
"""Bytes that any parser may hold back."""


@dataclass(frozen=True)
class Stream:
    """A parser that finds its frames in a stream.

    Args:
        make: creates a parser.
        frames: valid frames, as bytes and as parsed.
    """

    make: Callable[[], Any]
    frames: list[tuple[bytes, Any]]
    held: int = 4096
    """Bytes it may hold back."""


@dataclass(frozen=True)
class Whole:
    """A parser of complete frames: raises one of ``refuses``, or accepts.

    Args:
        parse: the parser.
        refuses: exceptions of a refusal.
        frames: valid frames.
    """

    parse: Callable[[bytes], Any]
    refuses: tuple[type[Exception], ...]
    frames: list[bytes]


def parsers() -> dict[str, Stream | Whole]:
    """Return all parsers by name."""
    rng = np.random.default_rng(0)
    ranges = scip.encode_array(rng.integers(20, 4000, 120), 3)
    replies = [
        scip.build_reply("MD0044072501000", "99", scip.wrap_lines(ranges)),
        scip.build_reply("BM", "00"),
        scip.build_reply("QT", "00"),
    ]
    sentences = [os4000.frame(text) for text in ("C320.5P1.2R-0.4T22.5", "C0.0P-12.3R45.6", "C359.9P0.0R0.0T-3.0")]
    commands = [maestro.Encoder().set_target(c, q) for c, q in ((0, 6000), (1, 5756), (2, 8000))]
    status = [ax12.Packet(unit, 0, rng.bytes(size)) for unit, size in ((1, 0), (2, 8), (1, 2))]
    pictures = [packets.CameraPacket(packets.PacketKind.PICTURE, n, n * 1000, rng.bytes(200)) for n in range(3)]
    return {
        "scip": Stream(
            scip.ScipParser, [(data, scip.ScipParser().feed(data)[0]) for data in replies], held=2 * scip.MAX_REPLY
        ),
        "os4000": Stream(os4000.Os4000Parser, [(data, os4000.parse(data)) for data in sentences]),
        "maestro": Stream(maestro.Decoder, [(data, maestro.Decoder().feed(data)[0]) for data in commands]),
        "ax12": Stream(ax12.Ax12Parser, [(packet.encode(), packet) for packet in status]),
        "camera": Stream(packets.PacketParser, [(packet.encode(), packet) for packet in pictures], held=HELD_LIMIT),
        "epos": Whole(_epos, (epos.FrameError,), [_epos_frame(entry) for entry in (od.STATUSWORD, od.TARGET_VELOCITY)]),
        "jpeg": Whole(webcam_driver.complete, (ValueError,), [_jpeg(rng)]),
        "wire-json": Whole(lambda data: wire.decode(topics.REQ_DRIVE, data), (InputError,), [_request()]),
        "wire-drive": Whole(lambda data: wire.decode(topics.DRIVE, data), (InputError,), [_drive()]),
        "wire-scan": Whole(lambda data: wire.decode(topics.SCAN, data), (InputError,), [_scan(rng)]),
    }


def _epos(data: bytes) -> epos.Frame:
    frame = epos.decode_body(data[0] if data else 0, data[1:])
    with suppress(epos.FrameError):
        epos.decode_segment(frame.words)
    return frame


def _epos_frame(entry: Any) -> bytes:
    frame = epos.read_request(entry, 1)
    return bytes((frame.opcode,)) + frame.body


def _jpeg(rng: np.random.Generator) -> bytes:
    segments = b"".join(
        bytes((0xFF, marker)) + (size + 2).to_bytes(2, "big") + rng.bytes(size)
        for marker, size in ((0xE0, 14), (0xDB, 65), (0xC0, 15), (0xC4, 29), (0xDA, 10))
    )
    return b"\xff\xd8" + segments + rng.bytes(300).replace(b"\xff", b"\0") + b"\xff\xd9"


def _request() -> bytes:
    request = DriveRequest(
        stamp=1, received=1, seq=1, source="ann", role=Role.GAMEPAD, lease=0.2, nonce="n", speed=0.1, front=0.0
    )
    return wire.encode(topics.REQ_DRIVE, request)


def _drive() -> bytes:
    feedback = DriveFeedback(stamp=1, received=1, seq=1, position=1.0, velocity=2.0, mode=DriveMode.ENABLED)
    return wire.encode(topics.DRIVE, feedback)


def _scan(rng: np.random.Generator) -> bytes:
    scan = LaserScan(
        stamp=1,
        received=1,
        seq=1,
        frame="lidar",
        start_angle=-math.pi / 2,
        end_angle=math.pi / 2,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.06,
        range_max=4.0,
        ranges=rng.uniform(0.1, 4.0, 91),
        codes=np.zeros(91, dtype=np.uint8),
    )
    return wire.encode(topics.SCAN, scan)


# Damage


def damaged(rng: np.random.Generator, frames: list[bytes], size: int) -> bytes:
    """Return ``size`` bytes of noise and damaged frames."""
    out = bytearray()
    while len(out) < size:
        out += broken(rng, frames) if rng.random() < 0.7 else rng.bytes(int(rng.integers(1, 400)))
    return bytes(out[:size])


def broken(rng: np.random.Generator, frames: list[bytes]) -> bytes:
    """Return one frame, possibly damaged."""
    data = bytearray(frames[rng.integers(len(frames))])
    for _ in range(rng.integers(0, 4)):
        at = int(rng.integers(len(data))) if data else 0
        match int(rng.integers(5)):
            case 0 if data:
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                del data[at : at + int(rng.integers(1, 9))]
            case 2:
                data[at:at] = data[at : at + int(rng.integers(1, 30))]
            case 3:
                data[at:at] = rng.bytes(int(rng.integers(1, 9)))
            case _:
                del data[at:]
    return bytes(data)


def pieces(rng: np.random.Generator, data: bytes) -> Iterator[bytes]:
    """Split the data as a serial line may: from single bytes to kilobytes."""
    at = 0
    while at < len(data):
        size = int(2 ** rng.uniform(0, 12))
        yield data[at : at + size]
        at += size


def held(parser: Any) -> int:
    """Return the number of buffered bytes."""
    names = [*getattr(parser, "__dict__", ()), *getattr(type(parser), "__slots__", ())]
    values = [getattr(parser, name) for name in names if hasattr(parser, name)]
    lists = [item for value in values if isinstance(value, list) for item in value]
    return sum(len(value) for value in (*values, *lists) if isinstance(value, bytes | bytearray))


# Runs


def fuzz_stream(stream: Stream, total: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the figures of a stream parser."""
    parser, sent, most, lost = stream.make(), 0, 0, 0
    frames = [data for data, _ in stream.frames]
    again = [stream.frames[n % len(frames)] for n in range(FRAMES)]
    while sent < total:
        for piece in pieces(rng, damaged(rng, frames, ROUND)):
            parser.feed(piece)
            sent += len(piece)
            most = max(most, held(parser))
        found = parser.feed(b"".join(data for data, _ in again))
        lost = max(lost, FRAMES - _found(found, [wanted for _, wanted in again]))
    return {"bytes": sent, "held": most, "lost": lost, "ok": most <= stream.held and lost <= IN_STEP}


def _found(found: list[Any], wanted: list[Any]) -> int:
    """Return the number of the latest frames that were found, counted from the end."""
    count = 0
    for a, b in zip(reversed(found), reversed(wanted), strict=False):
        if a != b:
            break
        count += 1
    return count


def fuzz_whole(whole: Whole, total: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the figures of a parser of complete frames."""
    sent = accepted = 0
    while sent < total:
        data = broken(rng, whole.frames) if rng.random() < 0.8 else rng.bytes(int(rng.integers(0, 400)))
        sent += len(data)
        try:
            whole.parse(data)
            accepted += 1
        except whole.refuses:
            pass
    for data in whole.frames:
        whole.parse(data)
    return {"bytes": sent, "accepted": accepted, "ok": True}


def fuzz_exchange(total: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the figures of the EPOS handshake, tested as a whole because its frames have no start marks."""

    async def main(clock: VirtualClock) -> dict[str, Any]:
        port = MemoryPort("epos")
        serving = asyncio.create_task(EposEmulator(clock).run(port.device))
        port.plug()
        sent = most = lost = 0
        try:
            async with await port.open() as link:
                exchanger = Exchanger(link, clock, 1)
                while sent < total:
                    noise = rng.bytes(int(rng.integers(1, 200)))
                    sent += len(noise)
                    port.device.write(noise) if rng.random() < 0.5 else setattr(port.device.faults, "garbage", noise)
                    failures = 0
                    while not await _reads(exchanger):
                        failures += 1
                    lost = max(lost, failures)
                    most = max(most, len(exchanger.strange))
        finally:
            serving.cancel()
            await asyncio.wait([serving])
        return {"bytes": sent, "held": most, "lost": lost, "ok": lost <= IN_STEP}

    return run_virtual(main)


async def _reads(exchanger: Exchanger) -> bool:
    try:
        await exchanger.read(od.STATUSWORD)
    except (DeviceTimeoutError, ProtocolError):
        return False
    return True


def run(total: int, seed: int, only: list[str]) -> dict[str, dict[str, Any]]:
    """Return the figures of every parser; one that raises is not ok."""
    results: dict[str, dict[str, Any]] = {}
    fuzzers: dict[str, Callable[[int, np.random.Generator], dict[str, Any]]] = {"epos-exchange": fuzz_exchange}
    for name, parser in parsers().items():
        fuzzers[name] = partial(fuzz_stream, parser) if isinstance(parser, Stream) else partial(fuzz_whole, parser)
    for name, fuzz in fuzzers.items():
        if only and name not in only:
            continue
        rng = np.random.default_rng([seed, len(name)])
        began = perf_counter()
        try:
            figures = fuzz(total, rng)
        except Exception as error:  # noqa: BLE001  # whatever comes is a finding
            figures = {"ok": False, "raised": repr(error)}
        results[name] = {**figures, "seconds": round(perf_counter() - began, 1)}
    return results


def main() -> int:
    """Fuzz; 0: no fault found."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("only", nargs="*", metavar="PARSER")
    options.add_argument("--bytes", type=int, default=10_000_000)
    options.add_argument("--seed", type=int, default=1)
    arguments = options.parse_args()
    results = run(arguments.bytes, arguments.seed, arguments.only)
    for name, figures in results.items():
        print(f"{name:12}", *(f"{key} {value}" for key, value in figures.items()))
    met = all(figures["ok"] for figures in results.values())
    print(json.dumps({"bench": "fuzz", "figures": results, "goals": {"ok": True, "bytes": 10_000_000}, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
