"""Driver and emulated camera on the virtual clock; a program and a server on the wall clock."""

import asyncio
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.cable import MemoryPort, SocketPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.command import CommandPort
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.driver import MjpegDriver
from monstertruck_drivers.mjpeg.emulator import MjpegEmulator
from monstertruck_drivers.tcp import TcpPort
from monstertruck_runtime.clock import SECOND, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.threads import inline
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.kit import DriverRig, Kept, background
from tests.unit.drivers.mjpeg.test_protocol import picture

SMALL = {"width": 160, "height": 120, "watchdog": 1.0}
WAYS = [{}, {"http": "/stream"}, {"http": "/shot.jpg", "poll": 10}]


class Plain:
    """A wall that becomes brighter."""

    def exposure(self, time_ns, size):
        return lambda: np.full((size[1], size[0], 3), min(10 + 20 * time_ns // SECOND, 255), np.uint8)


class Rig(DriverRig):
    def __init__(self, clock, emulated=None, **config):
        super().__init__(clock, MemoryPort("/dev/test"))
        self.config = MjpegConfig(**(SMALL | config))
        self.emulator = MjpegEmulator(clock, Plain(), emulated or self.config, offload=inline)
        self.out = Kept()
        self.driver = MjpegDriver(self.config, self.port, clock, self.out, self.events)


def on_bench(test, **config):
    async def main(clock):
        rig = Rig(clock, **config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main, start=SECOND)


@pytest.mark.parametrize("chunked", ["off", "on"])
@pytest.mark.parametrize("way", WAYS, ids=["plain", "multipart", "polled"])
def test_pictures_come_in_every_way(way, chunked):
    async def test(rig):
        if rig.config.http is not None:
            rig.emulator.inject("chunked", chunked)
        async with rig.driving():
            await rig.settle(2.0)
        rate = rig.config.poll or rig.config.rate
        assert len(rig.out.kept) == pytest.approx(2 * rate, abs=3)
        assert rig.out.last.data.startswith(b"\xff\xd8")
        assert rig.out.last.received - rig.out.last.stamp == pytest.approx(0.05 * SECOND, rel=0.01)
        assert not rig.events.kept

    on_bench(test, delay=0.05, **way)


@pytest.mark.parametrize("way", WAYS, ids=["plain", "multipart", "polled"])
def test_a_broken_picture_is_refused_and_the_next_one_taken(way):
    async def test(rig):
        async with rig.driving():
            for fault in ("corrupt", "truncate", "oversize"):
                await rig.settle(0.5)
                rig.emulator.inject(fault, "1")
                await rig.settle(0.5)
                assert rig.clock.now() - rig.out.last.received < 0.3 * SECOND, fault
        assert set(rig.events.reasons()) == {Reason.DEVICE_PROTOCOL}

    on_bench(test, most=20_000, **way)


@pytest.mark.parametrize("way", WAYS, ids=["plain", "multipart", "polled"])
def test_a_stuck_camera_ends_the_session_and_comes_back(way):
    async def test(rig):
        async def stick():
            await rig.settle(0.5)
            rig.emulator.inject("stuck", "on")

        async with background(stick()):
            with pytest.raises(DeviceTimeoutError, match=r"no image for 1\.0 s"):
                await rig.session()
        with pytest.raises(DeviceTimeoutError, match=r"no image for 1\.0 s"):
            await rig.session()
        rig.emulator.inject("stuck", "off")
        async with rig.driving():
            await rig.settle(0.5)
        assert rig.clock.now() - rig.out.last.received < 0.2 * SECOND

    on_bench(test, **way)


def test_answers_of_servers_that_are_no_camera():
    async def test(rig):
        for fault, error, text in (
            (("status", "401"), DeviceMismatchError, "/dev/test/stream: the server answers 401 Refused"),
            (("text", "on"), WrongDeviceError, "the server sends text/html, not images"),
        ):
            rig.emulator.inject(*fault)
            with pytest.raises(error, match=text):
                await rig.session()
            rig.emulator.inject("status", "off")

    on_bench(test, http="/stream")


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"SSH-2.0-OpenSSH_9\r\n\r\n", "not an HTTP server: the answer begins with 'SSH-2.0"),
        (b"HTTP/1.1 200 OK\r\n" + b"x" * 20_000, "header of the answer does not end"),
        (
            b"HTTP/1.1 200 OK\r\nContent-Type: image/jpeg\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
            "expected the length of a chunk",
        ),
    ],
)
def test_a_stranger_at_the_port(answer, text):
    async def main(clock):
        rig = Rig(clock, http="/stream")

        async def stranger():
            while True:
                await rig.port.device.read()
                rig.port.device.write(answer)

        async with rig.plugged_in(stranger()):
            with pytest.raises(ProtocolError, match=text):
                await rig.session()

    run_virtual(main, start=SECOND)


def test_a_size_that_differs_is_reported_once():
    async def test(rig):
        for _ in range(2):
            async with rig.driving():
                await rig.settle(0.5)
        ((reason, _, text, _),) = rig.events.kept
        assert reason is Reason.DEVICE_MISMATCH
        assert "the camera offers 320x240 at 15 Hz, expected 160x120" in text
        assert (await DEVICES["mjpeg"].identify(rig.port, rig.clock, rig.config))["width"] == 320

    on_bench(test, emulated=MjpegConfig(width=320, height=240))


def test_unknown_faults_and_settings_that_do_not_fit():
    async def test(rig):
        for words in (("corrupt", "many"), ("stuck", "maybe"), ("nonsense",)):
            with pytest.raises(InputError, match=r"known: corrupt\|truncate\|oversize N"):
                rig.emulator.inject(*words)
        rig.emulator.power_cycle()

    on_bench(test)
    with pytest.raises(ValueError, match="only an HTTP server is polled"):
        MjpegConfig(poll=5)
    with pytest.raises(ValueError, match="pattern"):
        MjpegConfig(http="/a b")


PROGRAM = """\
import sys, time
while True:
    sys.stdout.buffer.write(bytes.fromhex(sys.argv[1]))
    sys.stdout.flush()
    time.sleep(0.05)
"""


def driver(port, **config):
    rig = DriverRig(WallClock(), None)
    rig.out = Kept()
    rig.driver = MjpegDriver(MjpegConfig(**(SMALL | {"watchdog": 20.0} | config)), port, rig.clock, rig.out, rig.events)
    return rig


@pytest.mark.wall
def test_a_programs_output_and_its_end(tmp_path):
    pid_file = tmp_path / "pid"
    program = f"import os; open({str(pid_file)!r}, 'w').write(str(os.getpid()))\n" + PROGRAM

    async def main():
        rig = driver(CommandPort([sys.executable, "-c", program, picture().hex()]))
        async with rig.driving():
            await asyncio.wait_for(rig.out.count(3), 20)
        assert rig.out.last.data.startswith(b"\xff\xd8")
        pid = int(pid_file.read_text())
        async with asyncio.timeout(20):
            while _runs(pid):
                await asyncio.sleep(0.01)
        rig = driver(CommandPort([sys.executable, "-c", "import sys; sys.exit('no cameras available')"]))
        with pytest.raises(DeviceLostError, match="ended with exit code 1: no cameras available"):
            await rig.session()
        rig = driver(CommandPort(["rpicam-vid-that-is-not-there"]))
        with pytest.raises(DeviceLostError, match="rpicam-vid-that-is-not-there: cannot be started: No such file"):
            await rig.session()

    asyncio.run(main())


def _runs(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.wall
def test_a_server_on_the_network():
    async def main():
        with closing(SocketPort("127.0.0.1", 0)) as socket:
            emulator = MjpegEmulator(WallClock(), Plain(), MjpegConfig(http="/stream", width=1280, height=720))
            async with background(emulator.run(socket.device)):
                await asyncio.sleep(0)
                socket.plug()
                rig = driver(TcpPort(*socket.address), http="/stream", width=1280, height=720)
                async with rig.driving():
                    await asyncio.wait_for(rig.out.count(3), 20)
        assert not rig.events.kept

    asyncio.run(main())
