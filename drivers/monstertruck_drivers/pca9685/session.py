"""Access to the registers of one PCA9685 on an open bus; shared by the driver and `identify`."""

from monstertruck_drivers.i2c.host import I2cBus
from monstertruck_drivers.link import Link
from monstertruck_drivers.pca9685.config import Pca9685Config, Pca9685EscConfig
from monstertruck_drivers.pca9685.protocol import (
    CHANNELS,
    COUNTS,
    MODE2_RESET,
    OWN_ADDRESSES,
    WAKE_UP,
    PwmMode1,
    PwmRegister,
    count_us,
    counts_of,
    register_of,
)
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import WrongDeviceError

AWAKE = PwmMode1.AI
"""``MODE1`` while serving: outputs run, and the chip answers only at its own address."""


class Pca9685Session:
    """One session.

    Args:
        link: open link to the bus.
        clock: time.
        address: the chip's address.
        timeout: timeout for one transfer (s).
    """

    def __init__(self, link: Link, clock: Clock, address: int, timeout: float) -> None:
        self.name = f"{link.name} address 0x{address:02x}"
        self._bus = I2cBus(link, clock, timeout)
        self._clock = clock
        self._address = address

    async def write(self, data: bytes) -> None:
        """Write registers; the first byte is the address of the first register.

        Raises:
            DeviceLostError: the bus is gone.
            DeviceTimeoutError: the chip does not acknowledge.
        """
        await self._bus.transfer(self._address, data)

    def send(self, data: bytes) -> None:
        """Write registers without waiting for the acknowledgement.

        Raises:
            DeviceLostError: the bus is gone.
        """
        self._bus.send(self._address, data)

    async def read(self, register: int) -> int:
        """Read a register, whether or not auto-increment is on; raises the same errors as ``write``."""
        return (await self._bus.transfer(self._address, bytes((register,)), 1))[0]

    async def counts(self, channel: int) -> int:
        """Read a channel's pulse length in counts; raises the same errors as ``write``."""
        return counts_of(await self._bus.transfer(self._address, bytes((register_of(channel),)), 4))

    async def identify(self) -> tuple[PwmMode1, int]:
        """Verify that a PCA9685 answers, without writing to it.

        Returns:
            ``MODE1`` and the prescaler.

        Raises:
            DeviceLostError: the bus is gone.
            DeviceTimeoutError: nothing answers at this address.
            WrongDeviceError: the device lacks the sub-addresses of a PCA9685.
        """
        found = bytes([await self.read(PwmRegister.SUBADR1 + i) for i in range(len(OWN_ADDRESSES))])
        if found != OWN_ADDRESSES:
            raise WrongDeviceError(
                f"{self.name}: not a PCA9685: registers 2 to 5 are {found.hex(' ')}, expected {OWN_ADDRESSES.hex(' ')}"
            )
        return PwmMode1(await self.read(PwmRegister.MODE1)), await self.read(PwmRegister.PRE_SCALE)

    async def asleep(self) -> bool:
        """Whether the oscillator is off; raises the same errors as ``identify``."""
        mode, _ = await self.identify()
        return bool(mode & PwmMode1.SLEEP)

    async def set_up(self, prescaler: int) -> None:
        """Run the outputs at the configured frequency; pulses already running at that frequency are not interrupted.

        Raises:
            DeviceLostError: the bus is gone.
            DeviceTimeoutError: nothing answers at this address.
            WrongDeviceError: the device is not a PCA9685.
        """
        mode, present = await self.identify()
        if present != prescaler:
            await self.sleep()
            await self.write(bytes((PwmRegister.PRE_SCALE, prescaler)))
        await self.write(bytes((PwmRegister.MODE2, MODE2_RESET)))
        await self.write(bytes((PwmRegister.MODE1, AWAKE)))
        if present != prescaler or mode & PwmMode1.SLEEP:
            await self._clock.sleep(WAKE_UP)

    async def sleep(self) -> None:
        """Stop the oscillator and thus all pulses; raises the same errors as ``write``."""
        await self.write(bytes((PwmRegister.MODE1, AWAKE | PwmMode1.SLEEP)))

    async def is_set_up(self, prescaler: int) -> bool:
        """Whether mode and frequency match ``set_up``; raises the same errors as ``write``."""
        registers = PwmRegister.MODE1, PwmRegister.MODE2, PwmRegister.PRE_SCALE
        return [await self.read(register) for register in registers] == [AWAKE, MODE2_RESET, prescaler]


async def identify(link: Link, clock: Clock, settings: Pca9685Config | Pca9685EscConfig) -> dict[str, object]:
    """Read the registers without writing to the chip.

    Returns:
        JSON-compatible dict: ``address``, ``asleep``, ``prescaler``, ``frequency_hz`` for the configured oscillator,
        and ``channels``, the pulse in microseconds by channel (0: off).

    Raises:
        DeviceTimeoutError: nothing answers at this address.
        WrongDeviceError: another device answers.
    """
    config = settings.unit if isinstance(settings, Pca9685EscConfig) else settings
    session = Pca9685Session(link, clock, config.address, config.answer_timeout)
    mode, prescaler = await session.identify()
    # One by one: after power-up the chip does not increment the register.
    values = [[await session.read(register_of(channel) + i) for i in range(4)] for channel in range(CHANNELS)]
    count = count_us(prescaler, config.oscillator)
    return {
        "address": f"0x{config.address:02x}",
        "asleep": bool(mode & PwmMode1.SLEEP),
        "prescaler": prescaler,
        "frequency_hz": round(1e6 / (COUNTS * count), 2),
        "channels": [round(counts_of(bytes(one)) * count, 1) for one in values],
    }
