"""Identify a PCA9685 on a bus and read its outputs, without writing."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.pca9685.config import Pca9685Config, Pca9685EscConfig
from monstertruck_drivers.pca9685.protocol import CHANNELS, COUNTS, PwmMode1, count_us, counts_of, register_of
from monstertruck_drivers.pca9685.session import Pca9685Session
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: Pca9685Config | None = None) -> dict[str, object]:
    """Read registers alone.

    Returns:
        JSON-able: ``device``, ``port``, ``address``, ``asleep``, ``prescaler``, ``frequency_hz`` by the configured
        oscillator, ``channels``: pulse by channel in microseconds (0 = off).

    Raises:
        DeviceLostError: no such bus.
        DeviceTimeoutError: nothing at this address.
        WrongDeviceError: another device.
        PortBusyError: another process holds the emulated bus.
    """
    config = settings or Pca9685Config()
    async with await port.open() as link:
        session = Pca9685Session(link, clock, config.address, config.answer_timeout)
        mode, prescaler = await session.identify()
        # One by one: after power-up the chip does not increment the register.
        values = [[await session.read(register_of(channel) + i) for i in range(4)] for channel in range(CHANNELS)]
    count = count_us(prescaler, config.oscillator)
    return {
        "device": "NXP PCA9685",
        "port": port.name,
        "address": f"0x{config.address:02x}",
        "asleep": bool(mode & PwmMode1.SLEEP),
        "prescaler": prescaler,
        "frequency_hz": round(1e6 / (COUNTS * count), 2),
        "channels": [round(counts_of(bytes(one)) * count, 1) for one in values],
    }


async def probe_esc(port: Port, clock: Clock, settings: Pca9685EscConfig | None = None) -> dict[str, object]:
    """Identify the PCA9685 that a speed controller hangs on; see ``probe``."""
    return await probe(port, clock, None if settings is None else settings.unit)
