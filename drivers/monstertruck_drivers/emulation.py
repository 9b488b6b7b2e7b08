"""What emulators have in common: their interface, the physics they may ask for, what they are made from."""

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Protocol, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.cable import DeviceEnd, EmulatedPort, MemoryPort
from monstertruck_drivers.signals import Signals
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import Offload, in_thread

Array = NDArray[np.float64]


class FileTree:
    """Files below a folder; each changes at once and whole, and only if its text does.

    Args:
        root: folder that stands for /, or for a part of it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._texts: dict[str, str] = {}

    def put(self, path: str, text: str) -> None:
        """Make the file say ``text``, with a line end if it has none."""
        if self._texts.get(path) == text:
            return
        self._texts[path] = text
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        scratch = file.with_name(f".{file.name}")
        scratch.write_text(text if text.endswith("\n") else text + "\n")
        scratch.replace(file)

    def remove(self, path: str) -> None:
        """Take away a file or a folder with all its files."""
        target = self.root / path
        if target.is_dir():
            shutil.rmtree(target)
        else:
            target.unlink(missing_ok=True)
        self._texts = {
            known: text for known, text in self._texts.items() if known != path and not known.startswith(f"{path}/")
        }


class ReceivedBytes(bytearray):
    """The newest bytes of a stream, ``KEPT`` at most: what an emulator was sent, for tests."""

    KEPT: Final = 1 << 16

    def extend(self, data: Iterable[SupportsIndex], /) -> None:
        """Add bytes at the end; the oldest ones go."""
        super().extend(data)
        if len(self) > self.KEPT:
            del self[: -self.KEPT]


class Emulator(Protocol):
    """The device side of a protocol, byte for byte, with the device's own persistent state.

    Its attribute ``signals``, a ``Signals``, may be absent: see ``signals_of``.
    """

    name: str

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled; survives hosts that come, go and die."""

    def power_cycle(self) -> None:
        """Supply off and on again: volatile state is lost, stored settings stay."""

    def inject(self, fault: str, *values: str) -> None:
        """Start (or end) a device fault by name.

        Raises:
            InputError: unknown fault or bad value; the text lists what is known.
        """


def signals_of(emulator: object) -> Signals | None:
    """Return what an emulator reports and obeys; None if it does not say."""
    found = getattr(emulator, "signals", None)
    return found if isinstance(found, Signals) else None


class FileEmulator(Protocol):
    """A part of the computer that shows in files below /proc and /sys."""

    async def run(self) -> None:
        """Bring them up to date until cancelled."""

    def inject(self, fault: str, *values: str) -> None:
        """Start or end a fault.

        Raises:
            InputError: unknown fault or bad value.
        """


class RangeSource(Protocol):
    """What a lidar sees."""

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        """Raw distances in mm of one revolution that began at ``time_ns``.

        Shape (769,), step 0..768; values below 20 are the sensor's error codes.
        """


class RangeSheet(NamedTuple):
    """Ranges of a scanner by its data sheet."""

    least: float
    """Shortest range, m."""
    greatest: float
    """Longest range, m."""
    error: float
    """Bound of the error of short ranges, m."""
    relative_error: float
    """Bound of the error of longer ranges, as a share of the range."""
    dark: float | None = None
    """Longest range to a surface that reflects 10 % of the light, m; None = the data sheet states white ones only."""

    @property
    def sure(self) -> float:
        """Longest range at which the data sheet promises a return of any obstacle, m."""
        return self.greatest if self.dark is None else self.dark


class BeamSource(Protocol):
    """What the beams of a scanner of any geometry meet."""

    def beams(self, bearings: Array, times_ns: NDArray[np.int64], sheet: RangeSheet) -> Array:
        """Ranges of single beams, shape (n,), m: +inf = nothing within range, NaN = the measurement failed.

        Args:
            bearings: counter-clockwise from the scanner's x axis, shape (n,), rad.
            times_ns: instants of the beams, shape (n,), rising, over at most half a second.
            sheet: reach and noise.
        """


class ScannedRoom(RangeSource, BeamSource, Protocol):
    """What any lidar sees."""


class MotorReading(NamedTuple):
    """A motor shaft at one instant, in the controller's own sign."""

    turns: float
    """Shaft revolutions since power-up of the world."""
    rpm: float
    demand_rpm: float
    current_ma: float
    supply_v: float


class MotorPlant(Protocol):
    """A motor with its load, driven by a speed controller."""

    def command(self, time_ns: int, target_rpm: float | None, accel_rpm_s: float) -> None:
        """From ``time_ns`` on ramp towards ``target_rpm``; None = power stage off, coasting."""

    def reading(self, time_ns: int) -> MotorReading:
        """State at ``time_ns`` (never earlier than a time already requested)."""


class PulseSource(Protocol):
    """A servo controller's outputs."""

    def pulse_us(self, channel: int, time_ns: int) -> float | None:
        """Pulse being sent, microseconds; None = no pulses."""


class ServoPlant(Protocol):
    """Servos with their load; ``advance`` is called before any target changes."""

    def attach(self, pulses: PulseSource) -> None:
        """Name the controller whose pulses move the servos."""

    def advance(self, time_ns: int) -> None:
        """Let the servos follow their pulses up to ``time_ns``."""

    def analog_volts(self, channel: int, time_ns: int) -> float:
        """Voltage at an analog input."""


@dataclass(frozen=True, slots=True)
class CompassReading:
    """What the compass's sensors feel: magnetic heading and tilt, without the device's own quantisation."""

    heading_deg: float
    """Clockwise from magnetic north."""
    pitch_deg: float
    """Device's sign: nose up positive."""
    roll_deg: float
    """Device's sign: right side down positive."""
    temperature_c: float
    field: tuple[float, float, float]
    """Magnetic field in the device frame, milligauss."""
    acceleration: tuple[float, float, float]
    """In g."""


class AttitudeSource(Protocol):
    """Where a compass gets its truth from."""

    def compass(self, time_ns: int) -> CompassReading:
        """Reading at ``time_ns``."""


class ImuReading(NamedTuple):
    """What an inertial measurement unit feels, in its own axes: x forward, y left, z up."""

    angular_velocity: tuple[float, float, float]
    """rad/s."""
    acceleration: tuple[float, float, float]
    """Specific force, m/s^2: at rest and level, z is +9.81."""
    temperature_c: float


class ImuSource(Protocol):
    """Where an inertial measurement unit gets its truth from."""

    def imu(self, time_ns: int) -> ImuReading:
        """Reading at ``time_ns``."""


class WheelSource(Protocol):
    """What the encoders of the rear wheels count."""

    def wheels(self, time_ns: int) -> tuple[float, float]:
        """Angle of the left and of the right wheel, rad, forward positive; it grows from turn to turn."""


class SonarSource(Protocol):
    """What the robot's sonars hear, by their names."""

    def fire(self, name: str, time_ns: int) -> None:
        """A sonar sends.

        Raises:
            InputError: the robot has no sonar of that name.
        """

    def range(self, name: str) -> float:
        """Distance that the newest ping of a sonar came to, m, once its sound is back; inf = no echo."""


class JointSource(Protocol):
    """The joints of a mount: a pitch joint on the body, a roll joint on it, the device on the roll joint."""

    def angles(self, times_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True pitch and roll, rad, REP 103, at rising instants of the last second; each (n,)."""


class ViewSource(Protocol):
    """What a camera sees."""

    def exposure(self, time_ns: int, size: tuple[int, int], /) -> Callable[[], NDArray[np.uint8]]:
        """The picture of an instant: what is returned draws it, in any thread, one at a time.

        Args:
            time_ns: instant of the exposure.
            size: width and height, pixels.

        Returns:
            Makes (height, width, 3): red, green, blue; the top row first.
        """


class Horn(NamedTuple):
    """Of a servo of the lidar's mount."""

    zero: float | None
    """Position at which the lidar is parallel to the body, steps; None = as the driver's settings say."""
    direction: Literal[-1, 1] | None
    """+1 where a rising position turns the joint positively; None = as the driver's settings say."""


class Physics(Protocol):
    """The simulated world, as far as devices feel it."""

    @property
    def lidar(self) -> ScannedRoom:
        """What the lidar sees."""

    @property
    def view(self) -> ViewSource:
        """What stands around the truck."""

    @property
    def motors(self) -> tuple[MotorPlant, ...]:
        """Of the driven shafts."""

    @property
    def servos(self) -> ServoPlant:
        """Of the axles, with the inputs of their controller."""

    @property
    def compass(self) -> AttitudeSource:
        """Magnetic heading and tilt."""

    @property
    def sonars(self) -> SonarSource:
        """Of the robot's sides."""

    @property
    def imu(self) -> ImuSource:
        """Angular velocity and specific force."""

    @property
    def wheels(self) -> WheelSource:
        """Rear wheels that roll along."""

    def battery_volts(self, time_ns: int) -> float:
        """Voltage behind the battery's divider."""

    def horns(self) -> tuple[Horn, Horn]:
        """How the mount's pitch and roll servo were put together."""

    def carry_lidar(self, joints: JointSource) -> None:
        """Put the lidar onto a mount with joints."""

    def mount_torque(self, joint: int) -> float:
        """With which the lidar pushes its pitch (0) or roll (1) joint, Nm, at the newest instant of the world."""


@dataclass(frozen=True, slots=True)
class EmulatorSetup:
    """What an emulated device is made from."""

    role: str
    settings: Any
    """The driver's; None = defaults."""
    clock: Clock
    physics: Physics
    seed: int = 0
    """Of the device's noise."""
    port: EmulatedPort = field(default_factory=lambda: MemoryPort(""))
    """Where it is plugged in."""
    root: Path = Path()
    """Folder with proc and sys of the emulated computer."""
    offload: Offload = in_thread
    """Where what takes long is computed."""


EmulatorFactory = Callable[[EmulatorSetup], Any]
"""Makes an ``Emulator``; of a monitor, a ``FileEmulator``."""
