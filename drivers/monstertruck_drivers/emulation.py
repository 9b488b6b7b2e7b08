"""Emulator interface, the physics available to emulators, and building blocks for emulators."""

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Protocol, SupportsIndex, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.cable import DeviceEnd, EmulatedPort, MemoryPort
from monstertruck_drivers.signals import Signals
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import Offload, in_thread
from monstertruck_schemas.roles import DeviceRole

Array = NDArray[np.float64]


class FileTree:
    """Files below a folder; a file is replaced atomically, and only if its text changes.

    Args:
        root: folder that replaces /, or a part of it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._texts: dict[str, str] = {}

    def put(self, path: str, text: str) -> None:
        """Write ``text`` to the file; append a newline if it has none."""
        if self._texts.get(path) == text:
            return
        self._texts[path] = text
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        scratch = file.with_name(f".{file.name}")
        scratch.write_text(text if text.endswith("\n") else text + "\n")
        scratch.replace(file)

    def remove(self, path: str) -> None:
        """Remove a file, or a folder with all its files."""
        target = self.root / path
        if target.is_dir():
            shutil.rmtree(target)
        else:
            target.unlink(missing_ok=True)
        self._texts = {
            known: text for known, text in self._texts.items() if known != path and not known.startswith(f"{path}/")
        }


class ReceivedBytes(bytearray):
    """Latest bytes sent to an emulator, at most ``KEPT``, for tests."""

    KEPT: Final = 1 << 16

    def extend(self, data: Iterable[SupportsIndex], /) -> None:
        """Append bytes, and drop the oldest beyond ``KEPT``."""
        super().extend(data)
        if len(self) > self.KEPT:
            del self[: -self.KEPT]


@runtime_checkable
class Emulator(Protocol):
    """Device side of a protocol, byte for byte, including the device's persistent state.

    Its attribute ``signals``, a ``Signals``, may be absent: see ``signals_of``.
    """

    name: str

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled; survives hosts that connect, disconnect and die."""

    def power_cycle(self) -> None:
        """Switch the supply off and on: volatile state is lost, and stored settings persist."""

    def inject(self, fault: str, *values: str) -> None:
        """Start (or end) a device fault by name.

        Raises:
            InputError: unknown fault or invalid value; the message lists the known faults.
        """


def signals_of(emulator: object) -> Signals | None:
    """Return the signals of an emulator; None if it declares none."""
    found = getattr(emulator, "signals", None)
    return found if isinstance(found, Signals) else None


@runtime_checkable
class FileEmulator(Protocol):
    """Part of the computer that appears as files below /proc and /sys."""

    async def run(self) -> None:
        """Update the files until cancelled."""

    def inject(self, fault: str, *values: str) -> None:
        """Start or end a fault.

        Raises:
            InputError: unknown fault or invalid value.
        """


class RangeSource(Protocol):
    """Source of a lidar's scans."""

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        """Raw distances (mm) of one revolution that started at ``time_ns``.

        Shape (769,), step 0..768; values below 20 are the sensor's error codes.
        """


SIGMAS: Final = 2.0
"""Standard deviations of a range within the error bound of a data sheet."""


class RangeSheet(NamedTuple):
    """A scanner's range specifications according to its data sheet."""

    least: float
    """Minimum range (m)."""
    greatest: float
    """Maximum range (m)."""
    error: float
    """Error bound at short range (m)."""
    relative_error: float
    """Error bound at longer range, as a fraction of the range."""
    dark: float | None = None
    """Maximum range to a surface of 10 % reflectivity (m); None if the data sheet covers white surfaces only."""

    @property
    def noise(self) -> float:
        """Standard deviation of a short range (m): the data sheet's error bound equals `SIGMAS` standard deviations."""
        return self.error / SIGMAS

    @property
    def sure(self) -> float:
        """Maximum range at which the data sheet guarantees a return from any obstacle (m)."""
        return self.greatest if self.dark is None else self.dark


class BeamSource(Protocol):
    """Source of beam ranges for a scanner of any geometry."""

    def beams(self, bearings: Array, times_ns: NDArray[np.int64], sheet: RangeSheet) -> Array:
        """Ranges of single beams (m), shape (n,): +inf if nothing is within range, NaN if the measurement failed.

        Args:
            bearings: counter-clockwise from the scanner's x axis, shape (n,) (rad).
            times_ns: times of the beams, shape (n,), increasing, over at most half a second.
            sheet: maximum range and noise.
        """


class ScannedRoom(RangeSource, BeamSource, Protocol):
    """Range source for any lidar."""


class MotorReading(NamedTuple):
    """Motor shaft state at one time, with the controller's sign."""

    turns: float
    """Shaft revolutions since power-up of the world."""
    rpm: float
    demand_rpm: float
    current_ma: float
    supply_v: float


class MotorPlant(Protocol):
    """A motor with its load, driven by a speed controller."""

    def command(self, time_ns: int, target_rpm: float | None, accel_rpm_s: float) -> None:
        """Ramp towards ``target_rpm``, starting at ``time_ns``; None switches the power stage off (coasting)."""

    def reading(self, time_ns: int) -> MotorReading:
        """State at ``time_ns`` (never earlier than a time already requested)."""


class PulseSource(Protocol):
    """Outputs of a servo controller."""

    def pulse_us(self, channel: int, time_ns: int) -> float | None:
        """Width of the pulse being sent (us); None if no pulses are sent."""


class ServoPlant(Protocol):
    """Servos with their loads; ``advance`` must be called before any target changes."""

    @property
    def inputs(self) -> frozenset[int]:
        """Servo-controller channels that are analog inputs."""

    def attach(self, pulses: PulseSource) -> None:
        """Set the controller whose pulses move the servos."""

    def advance(self, time_ns: int) -> None:
        """Let the servos follow their pulses up to ``time_ns``."""

    def analog_volts(self, channel: int, time_ns: int) -> float:
        """Voltage at an analog input."""


@dataclass(frozen=True, slots=True)
class CompassReading:
    """True input of the compass: magnetic heading and tilt, without the device's quantisation."""

    heading_deg: float
    """Clockwise from magnetic north."""
    pitch_deg: float
    """Pitch with the device's sign: nose up positive."""
    roll_deg: float
    """Roll with the device's sign: right side down positive."""
    temperature_c: float
    field: tuple[float, float, float]
    """Magnetic field in the device frame, milligauss."""
    acceleration: tuple[float, float, float]
    """Acceleration (g)."""


class AttitudeSource(Protocol):
    """Source of true compass readings."""

    def compass(self, time_ns: int) -> CompassReading:
        """Reading at ``time_ns``."""


class ImuReading(NamedTuple):
    """True input of an inertial measurement unit, in its axes: x forward, y left, z up."""

    angular_velocity: tuple[float, float, float]
    """Angular velocity (rad/s)."""
    acceleration: tuple[float, float, float]
    """Specific force (m/s^2): at rest and level, z is +9.81."""
    temperature_c: float


class ImuSource(Protocol):
    """Source of true readings for an inertial measurement unit."""

    def imu(self, time_ns: int) -> ImuReading:
        """Reading at ``time_ns``."""


class WheelSource(Protocol):
    """Source of the rear wheel angles for the encoders."""

    def wheels(self, time_ns: int) -> tuple[float, float]:
        """Cumulative angles of the left and right wheel (rad), forward positive."""


class SonarSource(Protocol):
    """Source of the robot's sonar echoes, by sonar name."""

    def fire(self, name: str, time_ns: int) -> None:
        """Fire a ping from a sonar.

        Raises:
            InputError: the robot has no sonar with that name.
        """

    def range(self, name: str) -> float:
        """Distance measured by a sonar's latest ping (m), available once the echo has returned; inf if none."""


class JointSource(Protocol):
    """Joints of a mount: a pitch joint on the body, a roll joint on the pitch joint, the device on the roll joint."""

    def angles(self, times_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True pitch and roll (rad, REP 103) at increasing times within the last second; two arrays of shape (n,)."""


class ViewSource(Protocol):
    """Source of camera images."""

    def exposure(self, time_ns: int, size: tuple[int, int], /) -> Callable[[], NDArray[np.uint8]]:
        """Return a function that renders the image at one time; it may be called from any thread, one call at a time.

        Args:
            time_ns: time of the exposure.
            size: width and height (pixels).

        Returns:
            Function that returns an image of shape (height, width, 3): red, green, blue; top row first.
        """


class Horn(NamedTuple):
    """Assembly of a servo in the lidar's mount."""

    zero: float | None
    """Position at which the lidar is parallel to the body (steps); None: value from the driver's settings."""
    direction: Literal[-1, 1] | None
    """+1 if a rising position turns the joint in the positive direction; None: value from the driver's settings."""


class Physics(Protocol):
    """The simulated world as the devices measure it."""

    @property
    def lidar(self) -> ScannedRoom:
        """Source of the lidar's ranges."""

    @property
    def lidar_2(self) -> ScannedRoom:
        """Source of the second lidar's ranges."""

    @property
    def view(self) -> ViewSource:
        """Source of camera images of the truck's surroundings."""

    @property
    def motors(self) -> tuple[MotorPlant, ...]:
        """Motors of the driven shafts."""

    @property
    def servos(self) -> ServoPlant:
        """Axle steering servos, with the analog inputs of their controller."""

    @property
    def compass(self) -> AttitudeSource:
        """Magnetic heading and tilt."""

    @property
    def sonars(self) -> SonarSource:
        """Sonars on the robot's sides."""

    @property
    def imu(self) -> ImuSource:
        """Angular velocity and specific force."""

    @property
    def wheels(self) -> WheelSource:
        """Rolling rear wheels."""

    def battery_volts(self, time_ns: int) -> float:
        """Output voltage of the battery divider."""

    def horns(self) -> tuple[Horn, Horn]:
        """Assembly of the mount's pitch and roll servos."""

    def carry_lidar(self, joints: JointSource) -> None:
        """Attach the lidar to a mount with joints."""

    def mount_torque(self, joint: int) -> float:
        """Torque of the lidar on its pitch (0) or roll (1) joint at the latest simulated time (Nm)."""


@dataclass(frozen=True, slots=True)
class EmulatorSetup:
    """Parts that an emulated device is built from."""

    role: str
    settings: Any
    """Settings of the driver; None: defaults."""
    clock: Clock
    physics: Physics
    seed: int = 0
    """Seed of the device's noise."""
    port: EmulatedPort = field(default_factory=lambda: MemoryPort(""))
    """Port of the device."""
    root: Path = Path()
    """Folder with proc and sys of the emulated computer."""
    offload: Offload = in_thread
    """Runs long computations."""

    @property
    def room(self) -> ScannedRoom:
        """Range source for the lidar in this role."""
        return self.physics.lidar_2 if self.role == DeviceRole.LIDAR_2 else self.physics.lidar
