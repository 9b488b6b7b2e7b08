"""Links and ports: buffering, losing the peer, exclusivity, pacing and line faults."""

import asyncio
import contextlib
import os
import tty
from pathlib import Path

import pytest

from monstertruck_drivers import cable
from monstertruck_drivers.cable import MemoryPort, PtyPort
from monstertruck_drivers.link import BUFFER_LIMIT
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceLostError, PortBusyError
from tests.unit.drivers.kit import read_until


async def plugged() -> MemoryPort:
    port = MemoryPort("port")
    port.plug()
    return port


async def test_bytes_go_both_ways_and_are_buffered():
    port = await plugged()
    async with await port.open() as link:
        port.device.write(b"hello\nworld")
        assert await link.exactly(6) == b"hello\n"
        assert await link.exactly(3) == b"wor"
        assert await link.read() == b"ld"
        link.write(b"ping")
        assert await port.device.read() == b"ping"


async def test_a_reader_wakes_when_enough_bytes_came():
    port = await plugged()
    async with await port.open() as link:
        waiting = asyncio.create_task(link.exactly(4))
        for byte in b"abcd":
            await asyncio.sleep(0)
            port.device.write(bytes([byte]))
        assert await waiting == b"abcd"


async def test_a_read_may_wait_for_more_than_a_byte():
    port = await plugged()
    link = await port.open()
    reading = asyncio.create_task(link.read(least=3))
    for _ in range(2):
        port.device.write(b"a")
        await asyncio.sleep(0)
    assert not reading.done()
    port.device.write(b"bc")
    assert await reading == b"aabc"
    port.device.write(b"d")
    port.unplug()
    with pytest.raises(DeviceLostError):
        await link.read(least=2)
    assert await link.read() == b"d"


def test_each_wait_has_its_own_time_limit():
    async def main(clock: VirtualClock) -> list[float]:
        port = await plugged()
        gave_up = []
        async with await port.open() as link:
            for within in (0.5, 0.2, 0.3):
                begin = clock.now()
                port.device.write(b"a")
                with pytest.raises(TimeoutError):
                    await link.exactly(2, within)
                gave_up.append((clock.now() - begin) / SECOND)
                assert await link.read(within) == b"a"
            for _ in range(4):  # answers in time put the limit off, however often
                port.device.write(b"b", after=0.2)
                assert await link.read(0.3) == b"b"
            begin = clock.now()
            with pytest.raises(TimeoutError):
                await link.read(0.3)
            gave_up.append((clock.now() - begin) / SECOND)
            with pytest.raises(TimeoutError):
                await port.device.read(0.1)
        return gave_up

    assert run_virtual(main) == pytest.approx([0.5, 0.2, 0.3, 0.3], abs=1e-6)


def test_a_wait_without_limit_outlasts_the_limits_before_it():
    async def main(clock: VirtualClock) -> bytes:
        port = await plugged()
        async with await port.open() as link:
            port.device.write(b"a")
            waiting = asyncio.create_task(link.exactly(2, 0.1))
            await clock.sleep(0.05)
            port.device.write(b"b")
            await waiting
            port.device.write(b"late", after=5.0)
            return await link.read()

    assert run_virtual(main) == b"late"


async def test_the_buffer_is_bounded_and_keeps_the_newest():
    port = await plugged()
    async with await port.open() as link:
        for _ in range(5):
            port.device.write(b"a" * (BUFFER_LIMIT // 2))
        port.device.write(b"end")
        data = await link.read()
        assert len(data) == BUFFER_LIMIT
        assert data.endswith(b"end")


async def test_unplugging_ends_pending_and_later_reads_and_writes():
    port = await plugged()
    link = await port.open()
    pending = asyncio.create_task(link.read())
    await asyncio.sleep(0)
    port.unplug()
    with pytest.raises(DeviceLostError):
        await pending
    with pytest.raises(DeviceLostError):
        await link.read()
    with pytest.raises(DeviceLostError):
        link.write(b"x")
    with pytest.raises(DeviceLostError):
        await port.open()
    port.plug()
    (await port.open()).close()


async def test_bytes_that_came_before_the_loss_can_still_be_read():
    port = await plugged()
    link = await port.open()
    port.device.write(b"last words")
    port.unplug()
    assert await link.read() == b"last words"
    with pytest.raises(DeviceLostError):
        await link.read()


async def test_a_port_is_exclusive():
    port = await plugged()
    async with await port.open():
        with pytest.raises(PortBusyError):
            await port.open()
    (await port.open()).close()


async def test_cancelled_read_leaves_the_link_usable():
    port = await plugged()
    async with await port.open() as link:
        reading = asyncio.create_task(link.read())
        await asyncio.sleep(0)
        reading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await reading
        port.device.write(b"later")
        assert await link.read() == b"later"


def test_baud_rate_paces_both_directions():
    async def main(clock: VirtualClock) -> tuple[float, float]:
        port = await plugged()
        port.device.baud = 38400
        async with await port.open() as link:
            start = clock.now()
            port.device.write(b"x" * 48)
            await link.exactly(48)
            down = clock.now() - start
            start = clock.now()
            link.write(b"y" * 24)
            link.write(b"y" * 24)
            received = 0
            while received < 48:
                received += len(await port.device.read())
            return down / SECOND, (clock.now() - start) / SECOND

    assert run_virtual(main) == pytest.approx((0.0125, 0.0125), abs=1e-6)


async def test_line_faults():
    port = await plugged()
    line = port.device.faults
    line.seed(3)
    async with await port.open() as link:
        line.garbage = b"\xff\x00"
        port.device.write(b"ok")
        assert await link.read() == b"\xff\x00ok"
        line.chunk = 1
        port.device.write(b"abc")
        assert await link.exactly(3) == b"abc"
        line.chunk = None
        line.drop_rate = 0.5
        port.device.write(bytes(1000))
        assert 350 < len(await link.read()) < 650
        line.drop_rate, line.flip_rate = 0.0, 0.5
        port.device.write(bytes(1000))
        flipped = sum(byte != 0 for byte in await link.read())
        assert 350 < flipped < 650
        line.flip_rate = 0.0
        line.stalled = True
        port.device.write(b"lost")
        line.stalled = False
        port.device.write(b"seen")
        assert await link.read() == b"seen"
        line.deaf = True
        link.write(b"unheard")
        line.deaf = False
        link.write(b"heard")
        assert await port.device.read() == b"heard"


async def test_all_that_arrives_can_be_listened_to():
    port = await plugged()
    heard: list[tuple[bool, bytes]] = []
    port.device.on_bytes = lambda to_device, data: heard.append((to_device, data))
    async with await port.open() as link:
        link.write(b"ping")
        port.device.write(b"pong")
        port.device.faults.deaf = port.device.faults.stalled = True
        link.write(b"lost")
        port.device.write(b"lost")
    assert heard == [(True, b"ping"), (False, b"pong")]


async def test_what_is_no_serial_port_is_said_in_words(tmp_path: Path):
    with pytest.raises(DeviceLostError, match=r"^/dev/null: no serial port$"):
        await SerialPort(Path("/dev/null")).open()
    with pytest.raises(DeviceLostError, match=r": Is a directory$"):
        await SerialPort(tmp_path).open()


async def test_serial_port_over_a_pty(tmp_path: Path):
    pty = PtyPort(tmp_path / "dev")
    port = SerialPort(tmp_path / "dev")
    with pytest.raises(DeviceLostError, match="not plugged in"):
        await port.open()
    pty.plug()
    link = await port.open()
    pty.device.write(b"\x00\x0a\x0d\xff")
    assert await link.exactly(4) == b"\x00\x0a\x0d\xff"
    link.write(b"\x03\x11\x13")
    assert await pty.device.read() == b"\x03\x11\x13"
    with pytest.raises(PortBusyError):
        await port.open()
    pty.unplug()
    async with asyncio.timeout(1):
        with pytest.raises(DeviceLostError, match=r"dev: unplugged$"):
            await link.read()
    link.close()
    pty.plug()
    async with await port.open() as again:
        pty.device.write(b"back")
        assert await again.read() == b"back"
    pty.unplug()


async def test_what_a_full_tty_does_not_take_at_once_follows_in_order(tmp_path: Path):
    master, slave = os.openpty()
    tty.setraw(slave)
    (tmp_path / "dev").symlink_to(os.ttyname(slave))
    async with await SerialPort(tmp_path / "dev").open() as link:
        sent = bytes(range(256)) * 400
        for at in range(0, len(sent), 1000):
            link.write(sent[at : at + 1000])
        got = b""
        os.set_blocking(master, False)
        while len(got) < len(sent):
            await asyncio.sleep(0)
            with contextlib.suppress(BlockingIOError):
                got += os.read(master, 4096)
    assert got == sent
    os.close(master)
    os.close(slave)


async def test_a_vanished_pty_does_not_spin_the_loop(tmp_path: Path):
    pty = PtyPort(tmp_path / "dev")
    pty.plug()
    link = await SerialPort(tmp_path / "dev").open()
    pty.unplug()
    await asyncio.sleep(0.05)
    before = os.times()
    await asyncio.sleep(0.3)
    after = os.times()
    assert (after.user + after.system) - (before.user + before.system) < 0.1
    link.close()


async def test_what_a_device_says_within_a_usb_frame_arrives_together(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(cable, "FRAME", 0.05)
    pty = PtyPort(tmp_path / "dev")
    pty.plug()
    async with await SerialPort(tmp_path / "dev").open() as link:
        for byte in b"O", b"\x00":
            pty.device.write(byte)
            await asyncio.sleep(0.01)
        assert await link.read() == b"O\x00"
    pty.device.write(b"never sent")
    pty.unplug()
    pty.plug()
    async with await SerialPort(tmp_path / "dev").open() as link:
        pty.device.write(b"new")
        await asyncio.sleep(0.04)
        pty.device.write(b"er")
        assert await link.read() == b"newer"
    pty.unplug()


async def test_a_pty_nobody_reads_never_blocks_the_emulator(tmp_path: Path):
    pty = PtyPort(tmp_path / "dev")
    pty.plug()
    for _ in range(100):
        pty.device.write(b"z" * 4096)
        await asyncio.sleep(0.003)
    async with await SerialPort(tmp_path / "dev").open() as link:
        link.discard()
        await asyncio.sleep(0.01)
        pty.device.write(b"fresh")
        assert (await read_until(link, b"fresh")).endswith(b"fresh")
    pty.unplug()


def test_delayed_bytes_keep_their_order_also_when_the_delay_ends():
    async def main(clock: VirtualClock) -> bytes:
        port = await plugged()
        port.device.faults.delay = 0.05
        port.device.faults.chunk = 1
        async with await port.open() as link:
            port.device.write(bytes(range(100)))
            port.device.faults.delay = 0.0
            port.device.write(bytes(range(100, 200)))
            return await link.exactly(200)

    assert run_virtual(main) == bytes(range(200))


class Waiter:
    """Somebody who waits."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def on_bytes(self) -> None:
        self.heard.append("news")

    def on_timeout(self) -> None:
        self.heard.append("late")


async def test_a_wait_shorter_than_the_loops_timers_may_be_followed_by_a_long_one():
    port, waiter = await plugged(), Waiter()
    now = asyncio.get_running_loop().time()
    async with await port.open() as link:
        link.begin_wait(waiter, now + 0.0003)
        link.end_wait()
        link.begin_wait(waiter, now + 0.05)
        await asyncio.sleep(0.02)
        assert waiter.heard == []
        await asyncio.sleep(0.1)
        assert waiter.heard == ["late"]
        link.end_wait()


async def test_what_is_written_just_before_closing_arrives():
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        link = await SerialPort(Path(os.ttyname(slave))).open()
        link.write(b"deadman low")
        link.close()
        assert os.read(master, 100) == b"deadman low"
    finally:
        os.close(master)
        os.close(slave)
