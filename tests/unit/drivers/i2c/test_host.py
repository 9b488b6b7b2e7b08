"""Transfers over an emulated bus: answers, no acknowledgement, losses."""

import errno

import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.i2c.host import I2cBus
from monstertruck_drivers.i2c.protocol import I2cAnswer, I2cRequest, Packets, serve
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError
from tests.unit.drivers.kit import background


def on_bus(test, transfer=lambda address, data, count: data[:1] * count if address == 0x40 else None):
    async def main(clock):
        port = MemoryPort("/dev/i2c-test")
        port.plug()
        async with background(serve(port.device, transfer)), await port.open() as link:
            await test(port, I2cBus(link, clock, 0.1), clock)

    run_virtual(main)


def test_a_transfer_takes_the_time_of_its_bits():
    async def test(port, bus, clock):
        began = clock.now()
        assert await bus.transfer(0x40, b"\x07", 2) == b"\x07\x07"
        assert (clock.now() - began) / SECOND == pytest.approx(9 * 5 / 100_000, rel=0.01)

    on_bus(test)


def test_no_device_a_lost_answer_and_a_pulled_bus_differ():
    async def test(port, bus, clock):
        with pytest.raises(DeviceTimeoutError, match="no acknowledgement of address 0x41"):
            await bus.transfer(0x41, b"\x07", 1)
        port.device.faults.stalled = True
        with pytest.raises(DeviceTimeoutError, match=r"no answer for address 0x40 within 0\.1 s"):
            await bus.transfer(0x40, b"\x07", 1)
        port.device.faults.stalled = False
        assert await bus.transfer(0x40, b"\x09", 1) == b"\x09"
        port.unplug()
        with pytest.raises(DeviceLostError):
            await bus.transfer(0x40, b"\x07", 1)

    on_bus(test)


def test_a_late_answer_is_never_taken_for_the_next_one():
    async def test(port, bus, clock):
        port.device.faults.delay = 0.06
        with pytest.raises(DeviceTimeoutError):
            await bus.transfer(0x40, b"\x01", 1)
        port.device.faults.delay = 0.0
        assert await bus.transfer(0x40, b"\x02", 1) == b"\x02"

    on_bus(test)


@pytest.mark.parametrize(
    ("number", "error", "text"),
    [
        (errno.ENODEV, DeviceLostError, "the bus was removed"),
        (errno.ETIMEDOUT, DeviceTimeoutError, "Connection timed out"),
    ],
)
def test_errors_of_the_kernel(number, error, text):
    async def main(clock):
        port = MemoryPort("/dev/i2c-test")
        port.plug()

        async def failing():
            packets = Packets(I2cRequest)
            while True:
                for request in packets.feed(await port.device.read()):
                    port.device.write(bytes(I2cAnswer(request.number, number, b"")))

        async with background(failing()), await port.open() as link:
            with pytest.raises(error, match=text):
                await I2cBus(link, clock, 0.1).transfer(0x40, b"\x00")

    run_virtual(main)
