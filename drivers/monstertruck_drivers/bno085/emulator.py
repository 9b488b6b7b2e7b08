"""Emulated BNO085 in UART-RVC mode, byte for byte.

Like the real unit, it streams from power-up and ignores input. Its heading is 0 at power-up and drifts. The
accelerometer also measures the body's acceleration, which the unit's fusion removes from pitch and roll only slowly.
"""

from math import atan2, exp, hypot, radians
from typing import Final

import numpy as np

from monstertruck_drivers.bno085.protocol import BNO085_BAUD, INDICES, RATE, RvcFrame, build, measured
from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, ImuSource, ReceivedBytes
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

ACCELERATION_NOISE: Final = 4.0
"""Standard deviation of the accelerometer, 0.001 g."""
REPORTED: Final = ("yaw", "pitch", "roll", "x", "y", "z")


class Bno085Emulator(FaultyDevice):
    """Streaming unit.

    Faults (``inject``): ``frozen on|off`` (repeats one measurement, the index continues), ``silent on|off``, ``inverted
    on|off`` (the sign of yaw is inverted), ``bad_checksum N`` (the next N frames), ``skip N`` (N frames are not sent),
    ``half_frame``, ``reset``.

    Args:
        clock: time.
        source: physics to measure.
        seed: seed for noise and drift.
    """

    def __init__(self, clock: Clock, source: ImuSource, *, seed: int = 0) -> None:
        self.name = "bno085"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests."""
        self._clock = clock
        self._source = source
        self._rng = np.random.default_rng(seed)
        self.signals = Signals(clock.now, dict.fromkeys(REPORTED, SignalKind.NUMBER), self._rng)
        drift = radians(0.5) / 60  # maximum heading drift, rad/s
        self._drift = float(self._rng.uniform(-drift, drift))
        self.faults = FaultTable(
            self.name,
            {
                "frozen|silent|inverted on|off": False,
                "bad_checksum|skip N": 0,
                "half_frame": 0,
                "reset": self.power_cycle,
            },
        )
        self.power_cycle()

    def power_cycle(self) -> None:
        """Switch the supply off and on: heading and index restart at 0."""
        self._index, self._yaw = 0, 0.0
        self._turning = 0.0
        """Latest turn rate (rad/s)."""
        self._tilt: tuple[float, float] | None = None
        self._last: RvcFrame | None = None
        self.faults["half_frame"] = 1
        self._awake_at = self._clock.now() + 300_000_000  # nanoseconds from power-up to the first frame

    async def run(self, end: DeviceEnd) -> None:
        """Stream until cancelled."""
        end.baud = BNO085_BAUD
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        self.power_cycle()
        due = self._clock.now()
        while True:
            due += SECOND // RATE
            await self._clock.sleep_until(due)
            if due < self._awake_at:
                continue
            frame = self._frame(due)
            self._index += 1
            if self.faults["silent"]:
                continue
            if self.faults.strikes("skip"):
                continue
            data = build(frame)
            if self.faults.strikes("bad_checksum"):
                data = data[:9] + bytes((data[9] ^ 0x10,)) + data[10:]
            if self.faults.strikes("half_frame"):
                data = data[5:]
            end.write(data, 0.004)  # seconds from a measurement to the first byte of its frame

    def _frame(self, now: int) -> RvcFrame:
        reading = self._source.imu(now)
        turning = reading.angular_velocity[2] + self._drift
        if self.faults["inverted"]:
            turning = -turning
        self._yaw += (self._turning + turning) / 2 / RATE
        self._turning = turning
        x, y, z = reading.acceleration
        felt = atan2(-x, hypot(y, z)), atan2(y, z)
        fusion = 0.5  # time constant of pitch and roll following the accelerometer's vertical (s)
        share = 1.0 if self._tilt is None else 1.0 - exp(-1.0 / (RATE * fusion))
        pitch, roll = self._tilt or felt
        roll_rate, pitch_rate, _ = (rate / RATE for rate in reading.angular_velocity)
        pitch, roll = pitch + pitch_rate, roll + roll_rate
        self._tilt = pitch + share * (felt[0] - pitch), roll + share * (felt[1] - roll)
        true = measured(self._index, (self._yaw, *self._tilt), reading.acceleration)
        noise = np.rint(ACCELERATION_NOISE * self._rng.standard_normal(3)).astype(int).tolist()
        numbers = dict(zip(REPORTED, (*true[1:4], *(a + b for a, b in zip(true[4:], noise, strict=True))), strict=True))
        shown = {name: max(-32767, min(32767, self.signals.report(name, value))) for name, value in numbers.items()}
        if self.faults["frozen"] and self._last is not None:
            return self._last._replace(number=self._index % INDICES)
        self._last = RvcFrame(self._index % INDICES, **shown)
        return self._last


def emulated(setup: EmulatorSetup) -> Bno085Emulator:
    """Create a simulated robot's unit."""
    return Bno085Emulator(setup.clock, setup.physics.imu, seed=setup.seed)
