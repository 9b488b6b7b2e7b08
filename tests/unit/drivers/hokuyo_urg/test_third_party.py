"""A scanner client that is not ours, hokuyolx (MIT licence, for the maker's later ethernet models), at the emulator.

What it makes of the bytes is compared with what the world said, so that driver and emulator cannot share one
misunderstanding. Where it is not made for a URG-04LX the client is adapted, never the emulator:

* It speaks TCP only: a socket stands in for the USB cable.
* It never leaves SCIP 1.1, in which this model powers up: ``Client`` sends the switch on connecting.
* Before it synchronises clocks it asks for ``%ST``, unknown here: ``Client`` goes to standby by QT instead.
* It takes what one ``recv`` gives for one reply; with ``buf=1`` it reads to the end of a reply and no further.
* A request has two digits for the count, so more than 99 scans are an endless stream, ended by QT.
* Its ``get_angles`` counts from AMIN, and what filters by it fails where that is not 0: neither is asked for less
  than the whole field.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from itertools import islice, pairwise
from math import pi
from typing import Any, TypeVar, cast

import hokuyolx
import numpy as np
import pytest
from hokuyolx.exceptions import HokuyoStatusException
from numpy.typing import NDArray

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import RangeSource
from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator
from monstertruck_runtime.clock import WallClock
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World
from tests.unit.drivers.hokuyo_urg.rig import Pattern

T = TypeVar("T")
Scan = tuple[NDArray[np.uint32], int, int]
"""Values, sensor's counter, scans still to come."""

FIELD = slice(44, 726)
"""Steps that measure, by the data sheet."""
COUNTER = 1 << 24
"""Milliseconds after which the sensor's counter begins again."""


class Recorded:
    """Keeps what was said of every revolution that was asked for."""

    def __init__(self, source: RangeSource) -> None:
        self._source = source
        self.times: list[int] = []
        self.revolutions: list[NDArray[np.int32]] = []

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        said = self._source.scan(time_ns)
        self.times.append(time_ns)
        self.revolutions.append(said.copy())
        return said


class Client(hokuyolx.HokuyoLX):
    """hokuyolx with a URG-04LX's power-up and without what this model does not know."""

    def __init__(self, address: tuple[str, int]) -> None:
        super().__init__(activate=False, tsync=False, addr=address, buf=1, convert_time=False)

    def _connect_to_laser(self, close: bool = True) -> None:
        super()._connect_to_laser(close)
        self._sock.sendall(b"SCIP2.0\n")
        assert self._recv("SCIP2.0") == ["SCIP2.0", "0"]

    def _force_standby(self) -> None:
        self.standby()


class Cable(asyncio.Protocol):
    """The device's end of a TCP connection."""

    def __init__(self, device: DeviceEnd) -> None:
        self._device = device
        self.data_received = device.take
        self.transport: asyncio.Transport | None = None
        self.gone = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        self._device.connect(self.transport.write)

    def connection_lost(self, exc: Exception | None) -> None:
        self._device.connect(None)
        self.gone.set()


@contextlib.asynccontextmanager
async def served(emulator: HokuyoEmulator) -> AsyncIterator[tuple[str, int]]:
    """Address at which the emulator takes one client."""
    device = DeviceEnd(emulator.name)
    cable = Cable(device)
    running = asyncio.create_task(emulator.run(device))
    server = await asyncio.get_running_loop().create_server(lambda: cable, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()
    finally:
        if cable.transport is not None:
            cable.transport.abort()
            await cable.gone.wait()
        server.close()
        await server.wait_closed()
        running.cancel()
        await asyncio.wait([running])


async def use(source: RangeSource, work: Callable[[Client], T], **options: Any) -> T:
    """Let a thread work with a client while the emulator runs on this loop."""

    def run(address: tuple[str, int]) -> T:
        with contextlib.closing(Client(address)) as laser:
            return work(laser)

    async with served(HokuyoEmulator(WallClock(), source, **options)) as address:
        return await asyncio.to_thread(run, address)


def refusal(call: Callable[..., Any], *arguments: Any) -> str:
    with pytest.raises(HokuyoStatusException) as caught:
        call(*arguments)
    return caught.value.get_status()


def assert_counted(scans: list[Scan], times: list[int]) -> None:
    """The counters tell the milliseconds between the revolutions, across the end of the counter."""
    counted = [(b[1] - a[1]) % COUNTER for a, b in pairwise(scans)]
    assert counted == [(b - a) // 1_000_000 for a, b in pairwise(times)]


@pytest.mark.wall
async def test_scans_of_a_moving_truck_are_the_worlds():
    def work(laser: Client) -> list[Scan]:
        scans = list(islice(laser.iter_dist(), 40))
        laser.standby()
        return scans

    world, clock = World(WorldConfig(map="rooms"), seed=3), WallClock()
    recorded = Recorded(world.lidar)
    started = world.truth(clock.now())
    world.motors[0].command(clock.now(), -8000.0, 10_000.0)
    scans = await use(recorded, work, timer_start=COUNTER - 2000)

    assert len(scans) == 40
    for (scan, _, _), said in zip(scans, recorded.revolutions, strict=False):
        np.testing.assert_array_equal(scan, said[FIELD])
    assert_counted(scans, recorded.times[:40])
    assert scans[-1][1] < scans[0][1]
    assert {0, 19} <= {int(code) for scan, _, _ in scans for code in scan[scan < 20]}
    assert world.truth(clock.now()).x > started.x + 0.2


async def test_what_the_sensor_says_of_itself():
    def work(laser: Client) -> None:
        assert (laser.dmin, laser.dmax, laser.scan_freq) == (20, 5600, 10)
        assert (laser.ares, laser.amin, laser.aforw, laser.amax) == (1024, 44, 384, 725)
        angles = laser.get_angles(0, laser.amax - laser.amin)
        np.testing.assert_allclose(angles, (np.arange(44, 726) - 384) * 2 * pi / 1024, atol=1e-12)
        assert laser.version()["PROT"] == "SCIP 2.0"
        assert laser.version()["SERI"] == "H0706400"
        assert laser.sensor_state()["LASR"] == "OFF"
        assert laser.sensor_state()["SBPS"].startswith("19200[bps]<-")
        assert laser.activate()[0] == 0
        assert laser.activate()[0] == 2
        assert laser.sensor_state()["LASR"] == "ON"

    await use(Pattern(), work)


async def test_single_scans_carry_every_error_code():
    def work(laser: Client) -> list[NDArray[np.uint32]]:
        assert refusal(laser.get_dist) == "Denied"
        laser.activate()
        return [laser.get_dist(*steps)[1] for steps in ((), (0, 768), (100, 119))]

    recorded = Recorded(Pattern())
    whole, everything, codes = await use(recorded, work)
    np.testing.assert_array_equal(whole, recorded.revolutions[0][FIELD])
    np.testing.assert_array_equal(everything, recorded.revolutions[1])
    assert codes.tolist() == list(range(20))


async def test_a_finite_stream_of_clusters_counts_down_and_turns_the_laser_off():
    def work(laser: Client) -> list[Scan]:
        scans = list(laser.iter_dist(3, 90, 130, grouping=4, skips=1))
        assert refusal(laser.get_dist) == "Denied"
        return scans

    pattern = Pattern()
    scans = await use(pattern, work, timer_start=COUNTER - 300)
    for number, (scan, _, _) in enumerate(scans, 1):
        near = [value + number for value in (950, 970, 990)]
        far = [value + number for value in (1100, 1110, 1130, 1150)]
        assert scan.tolist() == [*near, 2, 6, 10, 14, *far]
    assert [left for _, _, left in scans] == [2, 1, 0]
    assert_counted(scans, pattern.times)
    assert all(later - earlier >= 200_000_000 for earlier, later in pairwise(pattern.times))


async def test_clocks_agree_after_synchronising():
    def work(laser: Client) -> int:
        laser.time_sync(N=5, dt=0.02)
        laser.activate()
        return laser.tzero + laser.get_dist()[0]

    pattern = Pattern()
    stamp = await use(pattern, work, timer_start=1_000_000)
    real = (pattern.times[0] + WallClock().real_offset()) / 1e6
    # The client reads its clock before it asks, so the request's way and the sensor's delay go into the offset.
    assert -20 <= stamp - real < 100


async def test_commands_of_later_models_are_refused():
    def work(laser: Client) -> None:
        assert refusal(laser.laser_state) == "CommandNotDefined"
        assert refusal(laser.get_intens) == "CommandNotDefined"
        assert refusal(next, laser.iter_intens()) == "CommandNotDefined"
        assert laser.sensor_state()["LASR"] == "OFF"

    await use(Pattern(), work)
