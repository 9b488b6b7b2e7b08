"""The emulated chip against the data sheet, and a client that is not ours: adafruit-circuitpython-pca9685 (MIT)."""

import sys
from types import ModuleType

import pytest

from monstertruck_drivers.pca9685.emulator import Pca9685Emulator
from monstertruck_drivers.pca9685.protocol import PwmMode1, PwmRegister, pulse
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import InputError

AI, SLEEP, RESTART = PwmMode1.AI, PwmMode1.SLEEP, PwmMode1.RESTART


class Chip:
    """The chip on a bus without a cable: transfers are answered at once."""

    def __init__(self, clock):
        self.clock = clock
        self.chip = Pca9685Emulator(clock)

    def write(self, *data, address=0x40):
        return self.chip.transfer(address, bytes(data), 0)

    def read(self, register, count=1):
        return self.chip.transfer(0x40, bytes((register,)), count)

    def pulse(self, channel):
        return self.chip.pulse_us(channel, self.clock.now())

    async def wake(self, more=0):
        self.write(PwmRegister.MODE1, AI | more)
        await self.clock.sleep(0.001)


def on_chip(test):
    async def main(clock):
        await test(Chip(clock))

    run_virtual(main, start=SECOND)


def test_power_up():
    async def test(chip):
        assert [chip.read(i)[0] for i in range(6)] == [0x11, 0x04, 0xE2, 0xE4, 0xE8, 0xE0]
        assert chip.read(PwmRegister.PRE_SCALE) == b"\x1e"
        assert chip.read(6, 4) == b"\0\0\0\0", "without auto-increment the register stays the same"
        assert chip.pulse(0) is None

    on_chip(test)


def test_the_prescaler_takes_values_in_sleep_only():
    async def test(chip):
        await chip.wake()
        chip.write(PwmRegister.PRE_SCALE, 121)
        assert chip.read(PwmRegister.PRE_SCALE) == b"\x1e"
        chip.write(PwmRegister.MODE1, AI | SLEEP)
        chip.write(PwmRegister.PRE_SCALE, 1)
        assert chip.read(PwmRegister.PRE_SCALE) == b"\x03", "the hardware forces at least 3"
        chip.write(PwmRegister.PRE_SCALE, 121)
        await chip.wake()
        chip.write(*pulse(2, 307))
        assert chip.pulse(2) == pytest.approx(307 * 122 / 25)

    on_chip(test)


def test_outputs_stay_off_after_sleep_until_the_restart_bit_or_their_registers_are_written():
    async def test(chip):
        await chip.wake()
        for channel in (0, 1):
            chip.write(*pulse(channel, 300))
        chip.write(PwmRegister.MODE1, AI | SLEEP)
        assert chip.read(PwmRegister.MODE1)[0] & RESTART
        chip.write(PwmRegister.MODE1, AI)
        chip.write(PwmRegister.MODE1, AI | RESTART)
        assert chip.pulse(0) is None, "the oscillator needs 500 us"
        await chip.clock.sleep(0.001)
        assert chip.pulse(0) is None
        chip.write(PwmRegister.MODE1, AI | RESTART)
        assert chip.pulse(0) == chip.pulse(1) == pytest.approx(300 * 31 / 25)
        assert not chip.read(PwmRegister.MODE1)[0] & RESTART
        chip.write(PwmRegister.MODE1, AI | SLEEP)
        await chip.wake()
        chip.write(*pulse(1, 300))
        assert chip.pulse(0) is None
        assert chip.pulse(1) == pytest.approx(300 * 31 / 25)
        assert not chip.read(PwmRegister.MODE1)[0] & RESTART

    on_chip(test)


def test_sleep_without_running_outputs_needs_no_restart():
    async def test(chip):
        await chip.wake()
        chip.write(PwmRegister.MODE1, AI | SLEEP)
        assert not chip.read(PwmRegister.MODE1)[0] & RESTART

    on_chip(test)


def test_auto_increment_rolls_over_and_all_led_registers_read_as_zero():
    async def test(chip):
        await chip.wake()
        chip.write(PwmRegister.ALL_LED_ON_L, 0, 0, 0x2C, 0x01)
        assert chip.read(PwmRegister.ALL_LED_ON_L, 4) == bytes(4)
        assert chip.read(0x42, 5) == b"\x00\x00\x2c\x01" + bytes((AI,)), "behind LED15 comes MODE1"
        assert chip.pulse(0) == chip.pulse(15) == pytest.approx(300 * 31 / 25)
        assert chip.read(PwmRegister.PRE_SCALE, 2)[1] == AI
        assert chip.write(0x46, 0) is None, "reserved registers are not acknowledged"

    on_chip(test)


def test_all_call_sub_addresses_and_the_reset_by_general_call():
    async def test(chip):
        assert chip.write(PwmRegister.MODE1, AI | PwmMode1.ALLCALL, address=0x70) == b"", "all-call is on at power-up"
        assert chip.write(PwmRegister.MODE1, AI | PwmMode1.SUB2, address=0x72) is None
        chip.write(PwmRegister.MODE1, AI | PwmMode1.SUB2)
        assert chip.write(PwmRegister.MODE1, AI, address=0x72) == b""
        assert chip.write(PwmRegister.MODE1, AI, address=0x70) is None
        assert chip.write(0x07, address=0) is None
        assert chip.write(0x06, address=0) == b""
        assert chip.read(PwmRegister.MODE1) == b"\x11"

    on_chip(test)


def test_inverted_outputs_full_bits_and_the_external_clock():
    async def test(chip):
        await chip.wake()
        chip.write(*pulse(0, 1024))
        chip.write(PwmRegister.MODE2, 0x14)
        assert chip.pulse(0) == pytest.approx(3072 * 31 / 25)
        chip.write(0x06, 0, 0x10, 0, 0)
        assert chip.pulse(0) is None, "always on is no pulse"
        chip.write(PwmRegister.MODE1, AI | PwmMode1.EXTCLK | SLEEP)
        await chip.wake()
        assert chip.read(PwmRegister.MODE1)[0] & PwmMode1.EXTCLK, "only a reset clears it"

    on_chip(test)


def test_faults():
    async def test(chip):
        await chip.wake()
        chip.write(*pulse(0, 307))
        chip.chip.inject("oscillator", "27e6")
        assert chip.pulse(0) == pytest.approx(307 * 31 / 27)
        chip.chip.inject("absent", "on")
        assert chip.read(0) is None
        chip.chip.inject("absent", "off")
        chip.chip.inject("brown_out")
        assert chip.read(0) == b"\x11"
        for words in (("absent", "yes"), ("nonsense",), ("oscillator", "fast")):
            with pytest.raises(InputError, match=r"expected 'absent|unknown fault|expected 'oscillator HZ'"):
                chip.chip.inject(*words)

    on_chip(test)


def test_false_signals():
    async def test(chip):
        await chip.wake()
        chip.chip.signals.inject("target_0", "ignored")
        chip.write(*pulse(0, 307))
        assert chip.pulse(0) is None
        chip.write(*pulse(1, 307))
        chip.chip.signals.inject("counts_1", "offset", "5")
        assert chip.read(0x0C, 2) == (312).to_bytes(2, "little")

    on_chip(test)


class Bus:
    """The bus as the client sees it, CircuitPython's ``busio.I2C``."""

    def __init__(self, chip):
        self.chip = chip

    def try_lock(self):
        return True

    def unlock(self):
        pass

    def _transfer(self, address, data, count=0):
        if (found := self.chip.chip.transfer(address, bytes(data), count)) is None:
            raise OSError("no such device")
        return found

    def writeto(self, address, buffer, *, start=0, end=None):
        self._transfer(address, buffer[start:end])

    def readfrom_into(self, address, buffer, *, start=0, end=None):
        buffer[start:end] = self._transfer(address, b"", len(buffer[start:end]))

    def writeto_then_readfrom(self, address, out, into, *, out_start=0, out_end=None, in_start=0, in_end=None):
        into[in_start:in_end] = self._transfer(address, out[out_start:out_end], len(into[in_start:in_end]))


@pytest.fixture
def client(monkeypatch):
    """The client's module; it names classes of ``busio``, which only loads on a known board."""
    busio = ModuleType("busio")
    busio.I2C = busio.SPI = object
    monkeypatch.setitem(sys.modules, "busio", busio)
    import adafruit_pca9685

    monkeypatch.setattr(adafruit_pca9685.time, "sleep", lambda _: None)
    return adafruit_pca9685


def test_another_client_sets_frequency_and_pulses(client):
    async def test(chip):
        device = client.PCA9685(Bus(chip))
        device.frequency = 50
        await chip.clock.sleep(0.01)
        assert device.frequency == pytest.approx(50, abs=0.2)
        device.channels[3].duty_cycle = round(1500 / 20000 * 0xFFFF)
        assert chip.pulse(3) == pytest.approx(1500, abs=10)
        device.channels[3].duty_cycle = 0xFFFF
        assert chip.pulse(3) is None
        device.channels[3].duty_cycle = 0
        assert chip.pulse(3) is None
        device.deinit()
        assert chip.read(PwmRegister.MODE1) == b"\x00"

    on_chip(test)
