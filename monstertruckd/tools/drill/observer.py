"""Observer of a drill: checks invariants against the bytes on the wires and the true state, not the daemon's reports.

Its inputs are the wires of all motor controllers, of steering, lidar and compass, the true state of the robot and the
operator's orders. Each rule reports the violations in an ``Observation`` at 100 Hz.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Protocol

import numpy as np

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.config import kind_of
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control, FrameError, Opcode, decode_body, join
from monstertruck_drivers.maestro.protocol import Code, Decoder, ServoCommand
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.steppers.protocol import Splitter
from monstertruck_kinematics.chassis import STILL, WHEEL_REACH, Chassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Twist2
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_schemas.roles import SHAFTS, DeviceRole
from monstertruck_sim.world.plant import TruthState
from monstertruck_sim.world.world import World
from monstertruckd.gate.config import GateConfig, SensorLimit
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

TRUTH_PERIOD: Final = SECOND // 100
STANDING_SPEED: Final = 0.01
"""Maximum true speed of a standing truck (m/s)."""
STOPS_WITHIN: Final = 0.6
"""Maximum time to standstill, from a fault that must stop the truck or from a disarm order (s)."""
SPEED_MARGIN: Final = 1.05
"""Allowed ratio of the true speed to the maximum commanded speed: the motor's overshoot."""
FAN: Final = np.linspace(-1.2, 1.2, 49)
"""Directions of the range checks ahead (rad)."""
ROOM: Final = np.linspace(0.0, 0.5, 26)
"""Distances of the path checks along the arc (m)."""
REVERSES_BELOW: Final = 0.05
"""True speed above which no motor may be commanded to reverse (m/s)."""
MOTORS: Final = (*SHAFTS, DeviceRole.WHEELS, DeviceRole.ACTUATORS)
"""Roles of motor controllers."""
WIRES: Final = (*MOTORS, DeviceRole.STEERING, DeviceRole.LIDAR, DeviceRole.COMPASS)
EPOS: Final = "epos"
"""Kind of motor controller whose wire is decoded, and whose quick-stop input is wired to the deadman line."""
MAESTRO: Final = "maestro"
"""Kind of servo controller whose wire is decoded, and whose output is the deadman line."""
STOP_CONTROLS: Final = frozenset((Control.QUICK_STOP, Control.DISABLE_VOLTAGE, Control.HALT))


@dataclass(frozen=True, slots=True)
class Violation:
    """A broken rule."""

    seconds: float
    """Time since the fault (s)."""
    rule: str
    text: str


class WireTap:
    """Tap of all bytes on a device's cable; it stays with the device when it is plugged in elsewhere.

    Args:
        port: port of the device.
        clock: source of time.
    """

    def __init__(self, port: MemoryPort, clock: Clock) -> None:
        self.to_device: list[tuple[int, bytes]] = []
        """(ns, bytes), stamped when the last byte reached the device."""
        self.to_host: list[tuple[int, bytes]] = []
        """(ns, bytes), stamped when the last byte reached the host."""
        self.heard: int | None = None
        """Time of the last bytes to the host (ns)."""
        self._clock = clock
        port.device.on_bytes = self._pass

    def _pass(self, to_device: bool, data: bytes) -> None:
        now = self._clock.now()
        (self.to_device if to_device else self.to_host).append((now, data))
        if not to_device:
            self.heard = now


class Received(Protocol):
    """Bytes that reached a device."""

    @property
    def to_device(self) -> Sequence[tuple[int, bytes]]:
        """Received bytes: (ns, bytes)."""


def written(tap: Received, since: int = 0) -> list[tuple[int, int, int]]:
    """Return the objects the host wrote to an EPOS: (ns, index, raw value); incomplete frames are skipped."""
    return _writes(item for item in tap.to_device if item[0] >= since)


def _writes(received: Iterable[tuple[int, bytes]]) -> list[tuple[int, int, int]]:
    found = []
    for instant, data in received:
        with suppress(FrameError):
            words = decode_body(Opcode.WRITE, data).words
            if len(words) == 4:
                found.append((instant, words[0], join(words[2], words[3])))
    return found


class MotorWire(ABC):
    """Motor speeds commanded by the bytes to a motor controller; consumes each item of a tap once."""

    def __init__(self, tap: WireTap) -> None:
        self.tap = tap
        self._read = 0

    def _fresh(self) -> list[tuple[int, bytes]]:
        fresh = self.tap.to_device[self._read :]
        self._read += len(fresh)
        return fresh

    @abstractmethod
    def read(self) -> Iterator[tuple[int, int, float]]:
        """Return the commands since the last call: (ns, shaft, m/s over ground); 0 is any stop."""

    def forget(self) -> None:
        """Discard all bytes so far."""
        self._read = 0
        self.tap.to_device.clear()
        self.tap.to_host.clear()


class _EposWire(MotorWire):
    """Wire of one shaft's EPOS.

    Args:
        tap: tap of its cable.
        shaft: index of the shaft.
        rpm: motor speed at 1 m/s, in the controller's sign (rpm).
    """

    def __init__(self, tap: WireTap, shaft: int, rpm: float) -> None:
        super().__init__(tap)
        self._shaft, self._rpm = shaft, rpm

    def read(self) -> Iterator[tuple[int, int, float]]:
        """See ``MotorWire``."""
        for instant, index, value in _writes(self._fresh()):
            if index == od.TARGET_VELOCITY.index:
                rpm = value - (1 << 32) if value >= 1 << 31 else value
                yield instant, self._shaft, rpm / self._rpm
            elif index == od.CONTROLWORD.index and value in STOP_CONTROLS:
                yield instant, self._shaft, 0.0


class _StepperWire(MotorWire):
    """Wire of all shafts of a body with steppers.

    Args:
        tap: tap of the controller's cable.
        config: configuration of the driver.
        drivetrain: from motor to wheel.
    """

    def __init__(self, tap: WireTap, config: StepperConfig, drivetrain: DriveTrain) -> None:
        super().__init__(tap)
        self._lines = Splitter()
        step = drivetrain.speed(config.turn) / 1000
        self._speeds = [-step if inverted else step for inverted in config.inverted[: config.motors]]
        """Speeds over ground at a rate of 1 (m/s)."""

    def read(self) -> Iterator[tuple[int, int, float]]:
        """See ``MotorWire``."""
        for instant, data in self._fresh():
            for line in self._lines.feed(data):
                if line.verb == "R":
                    asked = zip(line.words, self._speeds, strict=False)
                    yield from ((instant, shaft, int(rate) * each) for shaft, (rate, each) in enumerate(asked))
                elif line.verb in ("Q", "D"):
                    yield from ((instant, shaft, 0.0) for shaft in range(len(self._speeds)))


class _ObeyedOrders(MotorWire):
    """Shafts of a controller with a protocol unknown here: its motor commands, read from the world.

    Args:
        tap: tap of the controller's cable.
        world: source of the motor commands.
        shafts: indices of the driven shafts.
        rpm: motor speed at 1 m/s, in the controller's sign (rpm).
        clock: source of time.
    """

    def __init__(self, tap: WireTap, world: World, shafts: Sequence[int], rpm: float, clock: Clock) -> None:
        super().__init__(tap)
        self._world, self._shafts, self._rpm, self._clock = world, shafts, rpm, clock
        self._newest = dict.fromkeys(shafts, 0.0)

    def read(self) -> Iterator[tuple[int, int, float]]:
        """See ``MotorWire``; stamped with the time of the call."""
        self.forget()
        now = self._clock.now()
        for shaft in self._shafts:
            speed = self._world.motors[shaft].target_rpm / self._rpm
            if speed != self._newest[shaft]:
                self._newest[shaft] = speed
                yield now, shaft, speed


def _motor_wires(
    config: SimulatedTruckConfig, taps: Mapping[str, WireTap], world: World, clock: Clock
) -> list[MotorWire]:
    truck = config.sim.world.truck
    drivetrain = DriveTrain(truck.motor.ratio, truck.wheel_radius)
    rpm = drivetrain.motor_rate(1.0) * 30 / math.pi * (-1 if truck.motor.inverted else 1)
    wires: list[MotorWire] = []
    for role, device in config.devices.present().items():
        if role in SHAFTS:
            shaft = SHAFTS.index(DeviceRole(role))
            known = device.driver.kind == EPOS
            wires.append(
                _EposWire(taps[role], shaft, rpm) if known else _ObeyedOrders(taps[role], world, [shaft], rpm, clock)
            )
        elif role in (DeviceRole.WHEELS, DeviceRole.ACTUATORS):
            shafts = range(len(truck.chassis().shafts))
            known = device.driver.kind == "steppers"
            wires.append(
                _StepperWire(taps[role], device.driver, drivetrain)
                if known
                else _ObeyedOrders(taps[role], world, shafts, rpm, clock)
            )
    return wires


class ServoWire(Protocol):
    """Pulses commanded from a servo controller; consumes each request once."""

    def read(self) -> Iterator[tuple[int, float]]:
        """Return the pulses since the last call: (channel, us)."""


class _MaestroWire:
    """Wire of a Maestro.

    Args:
        tap: tap of its cable.
        crc: whether commands have a check sum.
        asked: called with the channel and the time (ns) of each request for a position or voltage.
    """

    def __init__(self, tap: WireTap, *, crc: bool, asked: Callable[[int, int], None]) -> None:
        self._tap, self._decoder, self._asked = tap, Decoder(crc=crc), asked

    def read(self) -> Iterator[tuple[int, float]]:
        """See ``ServoWire``."""
        received, self._tap.to_device[:] = list(self._tap.to_device), []
        self._tap.to_host.clear()
        for instant, data in received:
            for command in self._decoder.feed(data):
                if not isinstance(command, ServoCommand):
                    continue
                if command.code is Code.SET_TARGET and command.value:
                    yield command.data[0], command.value / 4
                elif command.code is Code.GET_POSITION:
                    self._asked(command.data[0], instant)


class _SentPulses:
    """Servo controller whose protocol this module does not know; its pulses are read from the world.

    Args:
        tap: tap of its cable.
        world: source of the pulses.
        channels: servo channels.
        clock: source of time.
    """

    def __init__(self, tap: WireTap, world: World, channels: Iterable[int], clock: Clock) -> None:
        self._tap, self._world, self._clock = tap, world, clock
        self._newest: dict[int, float | None] = dict.fromkeys(channels)

    def read(self) -> Iterator[tuple[int, float]]:
        """See ``ServoWire``."""
        self._tap.to_device.clear()
        self._tap.to_host.clear()
        source, now = self._world.plant.pulses, self._clock.now()
        if source is None:
            return
        for channel, before in self._newest.items():
            pulse = source.pulse_us(channel, now)
            if pulse is not None and pulse != before:
                self._newest[channel] = pulse
                yield channel, pulse


@dataclass(frozen=True, slots=True)
class Observation:
    """Observed state at one instant."""

    now: int
    """Time (ns)."""
    truth: TruthState
    twist: Twist2
    """True body twist (m/s, m/s, rad/s)."""
    targets: tuple[tuple[int, int, float], ...]
    """Motor speeds commanded since the previous observation: (ns, shaft, m/s over ground); 0 is any stop."""
    target: tuple[float, ...]
    """Speed of every shaft in the latest commands (m/s)."""
    pulses: tuple[tuple[int, float], ...]
    """Servo pulses commanded since the previous observation: (channel, us)."""


Broken = Iterator[tuple[str, str]]
"""Names of the rules that an observation breaks, each with a description."""

Rule = Callable[[Observation], Broken]
"""A check of the observer; gets every observation once, in order."""


class Duration:
    """Uninterrupted duration of a condition."""

    def __init__(self) -> None:
        self._since: int | None = None

    def update(self, now: int, *, so: bool) -> float:
        """Return the duration at ``now`` (ns) in seconds; 0 while the condition does not hold."""
        self._since = (now if self._since is None else self._since) if so else None
        return 0.0 if self._since is None else (now - self._since) / SECOND


class _Standstill:
    """The truck stands when the operator or a fault requires it; also measures how far and how long it kept moving."""

    def __init__(self) -> None:
        self.began = 0
        """Start of the fault (ns)."""
        self.must_stop = False
        """The fault must stop the truck."""
        self.disarms = False
        """The truck may not restart by itself after the fault."""
        self.disarmed: int | None = None
        """Time of the operator's disarm order (ns)."""
        self.estopped: int | None = None
        """Time of the operator's emergency stop (ns), until the reset."""
        self.stood: int | None = None
        """Time of the first standstill after the fault (ns)."""
        self.top_speed = 0.0
        """Maximum true speed since the fault (m/s)."""
        self._path: list[tuple[float, float]] = []
        self._rest: tuple[float, float] | None = None
        """Position of the last rest (m)."""

    def begin(self, now: int, *, must_stop: bool, disarms: bool) -> None:
        """Start a fault."""
        self.began, self.must_stop, self.disarms = now, must_stop, disarms
        self.stood, self.top_speed = None, 0.0
        self._path.clear()

    def metres(self) -> float:
        """True distance travelled since the fault, to standstill or until the call (m)."""
        return sum(math.dist(a, b) for a, b in pairwise(self._path))

    def __call__(self, seen: Observation) -> Broken:
        now, speed = seen.now, seen.truth.v
        self.top_speed = max(self.top_speed, abs(speed))
        resting, here = abs(speed) <= STANDING_SPEED, (seen.truth.x, seen.truth.y)
        if self.stood is None:
            self._path.append(here)
            if resting:
                self.stood = now
        if resting:
            self._rest = here
        # 0.003: distance from its rest within which a truck still stands (m): a braked truck rocks on tyres and
        # springs
        if self._rest is not None and math.dist(here, self._rest) <= 0.003:
            return
        ordered = min((at for at in (self.disarmed, self.estopped) if at is not None), default=now)
        asked = max((abs(each) for *_, each in seen.targets), default=0.0)
        # 0.1: maximum delay of a stop order on the wire (s)
        if now > ordered + 0.1 * SECOND and asked > 0:
            yield "stopping bytes", f"{asked:.3f} m/s asked for at {speed:.3f} m/s though it was ordered to stop"
        limit = round(STOPS_WITHIN * SECOND)
        if self.disarmed is not None and now > self.disarmed + limit:
            yield "disarmed", f"{speed:.3f} m/s though disarmed"
        if self.estopped is not None and now > self.estopped + limit:
            yield "emergency stop", f"{speed:.3f} m/s though stopped and not reset"
        if self.must_stop and now > self.began + limit:
            yield "stop", f"{speed:.3f} m/s: must stand"
        if self.disarms and self.stood is not None:
            yield "unarmed", f"{speed:.3f} m/s: moved again without being armed"


class _Speeds:
    """True and commanded speeds stay within the limits; no command reverses the direction before standstill.

    Args:
        chassis: chassis of the body.
        backwards: reverse speed limit (m/s).
        forwards: forward speed limit (m/s).
    """

    def __init__(self, chassis: Chassis, backwards: float, forwards: float) -> None:
        self._chassis = chassis
        self._limits = backwards, forwards

    def __call__(self, seen: Observation) -> Broken:
        speed = seen.truth.v
        if abs(speed) > (most := self._limits[speed > 0]) * SPEED_MARGIN:
            yield "speed", f"{speed:.3f} m/s: at most {most:.3f}"
        for *_, asked in seen.targets:
            most = self._limits[asked > 0] if len(seen.target) == 1 else max(self._limits)
            if abs(asked) > most * 1.01:
                yield "speed bytes", f"{asked:.3f} m/s: at most {most:.3f}"
        if len(seen.target) == 1:
            yield from self._reversal(speed, [asked for *_, asked in seen.targets])
        elif seen.targets and not self._chassis.steered:
            vx, vy, _ = self._chassis.twist(self._chassis.input_speeds(seen.target))
            travelled = math.hypot(*seen.twist[:2])
            along = (vx * seen.twist[0] + vy * seen.twist[1]) / max(travelled, REVERSES_BELOW)
            yield from self._reversal(travelled, [along + STANDING_SPEED])

    @staticmethod
    def _reversal(speed: float, targets: Iterable[float]) -> Broken:
        for asked in targets:
            if abs(speed) > REVERSES_BELOW and asked * speed < 0:
                yield "reversal bytes", f"{asked:.3f} m/s at {speed:.3f} m/s"


class _Ramp:
    """Commanded speeds do not rise faster than the ramp from the previous speed.

    Args:
        accelerations: ramp of each shaft (m/s^2).
    """

    def __init__(self, accelerations: Iterable[float]) -> None:
        self._accelerations = tuple(accelerations)
        self._newest: list[tuple[float, int] | None] = [None] * len(self._accelerations)
        """Maximum commanded speed by the ramp (m/s) and its time (ns); None if the ramp restarts."""

    def __call__(self, seen: Observation) -> Broken:
        for instant, shaft, speed in seen.targets:
            if speed == 0:  # a drive stopped for a moment may resume its previous speed
                self._newest[shaft] = None
                continue
            acceleration = self._accelerations[shaft]
            # 0.1: maximum lead of the bytes on the wire over the ramp (s): ticks and exchanges are not
            # synchronised
            ramp = abs(speed) + acceleration * 0.1
            if (newest := self._newest[shaft]) is not None:
                before, then = newest
                allowed = before + acceleration * (instant - then) / SECOND
                if abs(speed) > allowed * 1.01:
                    yield "ramp bytes", f"{speed:.3f} m/s: at most {allowed:.3f} so soon"
                ramp = min(ramp, allowed)
            self._newest[shaft] = ramp, instant


def _accelerations(chassis: Chassis, config: GateConfig) -> tuple[float, ...]:
    """Return the maximum acceleration of each shaft within the body's limits (m/s^2)."""
    if len(chassis.shafts) == 1:
        return (config.acceleration,)
    if chassis.steered:  # each wheel rolls in its steered direction
        reach = math.hypot(chassis.bicycle.wheelbase, chassis.bicycle.track) / 2
        return (config.acceleration + config.yaw_acceleration * reach,) * len(chassis.shafts)
    forward, turned = chassis.shafts_along((1.0, 0.0, 0.0)), chassis.shafts_along(chassis.possible((0.0, 0.0, 1.0)))
    free = chassis.freedom == "both"
    aside = chassis.shafts_along((0.0, 1.0, 0.0)) if free else (0.0,) * len(forward)
    return tuple(
        config.acceleration * math.hypot(x, y) + config.yaw_acceleration * abs(turn)
        for x, y, turn in zip(forward, aside, turned, strict=True)
    )


class _HeldShaft:
    """A blocked motor is not driven further."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._held = Duration()

    def __call__(self, seen: Observation) -> Broken:
        held = [asked for shaft, asked in enumerate(seen.target) if asked and self._world.shaft_blocked(shaft)]
        # 1.0: maximum time that a motor is commanded to turn a held shaft (s)
        if self._held.update(seen.now, so=bool(held)) > 1.0:
            yield "held shaft", f"{held[0]:.3f} m/s asked for though the shaft is held"


class _PulsedSteering:
    """Steering angles commanded by the latest pulses; straight ahead for a body without servos.

    Args:
        config: configuration of the robot.
    """

    def __init__(self, config: SimulatedTruckConfig) -> None:
        truck = config.sim.world.truck
        self.chassis = truck.chassis()
        self._models = {servo.channel: servo for servo in truck.servos}
        self._arms = dict.fromkeys(self._models, 0.0)
        """Servo angles (rad)."""

    def take(self, channel: int, pulse_us: float) -> None:
        """Take a commanded pulse."""
        if (model := self._models.get(channel)) is not None:
            self._arms[channel] = math.radians((pulse_us - model.centre_us) / model.us_per_degree)

    @property
    def angles(self) -> tuple[float, ...]:
        """Return the angles of the axles or wheels (rad)."""
        return self.chassis.steering(*self._arms.values())


class _Pulses:
    """Commanded servo angles stay within the limits of servos and axles.

    Args:
        config: configuration of the truck, with a steering device.
        steering: steering model of the pulses.
    """

    def __init__(self, config: SimulatedTruckConfig, steering: _PulsedSteering) -> None:
        assert config.devices.steering is not None
        self._steering = steering
        self._limits = {servo.channel: servo for servo in config.devices.steering.driver.servos}
        wheels = len(steering.chassis.straight) > 2
        self._angle = (WHEEL_REACH if wheels else config.gate.angle) + 0.01  # rounding of pulses (rad)

    def __call__(self, seen: Observation) -> Broken:
        for channel, pulse_us in seen.pulses:
            limits = self._limits.get(channel)
            if limits is not None and not limits.min_us - 0.5 <= pulse_us <= limits.max_us + 0.5:
                yield "pulse bytes", f"{pulse_us:.1f} us: {limits.min_us:g} to {limits.max_us:g}"
            self._steering.take(channel, pulse_us)
            if (angle := max(map(abs, self._steering.angles))) > self._angle:
                yield "angle bytes", f"axle at {angle:.3f} rad: at most {self._angle:.3f}"


class _Turning:
    """The robot turns as the bytes command: by the pulses, and by the motors if it has several.

    A held shaft turns a robot with several motors, whatever its bytes command. ``_HeldShaft`` limits this time.

    Args:
        steering: steering of the pulses.
        world: world of the shafts.
    """

    def __init__(self, steering: _PulsedSteering, world: World) -> None:
        self._steering = steering
        self._world = world
        self._course: Twist2 = STILL
        """Latest commanded motion of several motors."""
        self._turn_errors: deque[tuple[int, float]] = deque()

    def begin(self) -> None:
        """Discard earlier turns."""
        self._turn_errors.clear()

    def __call__(self, seen: Observation) -> Broken:
        now = seen.now
        turned = 0.0 if self._held(seen) else (seen.truth.wz - self._asked(seen)) * TRUTH_PERIOD / SECOND
        self._turn_errors.append((now, turned))
        # Maximum difference between the true and the commanded turn (rad), and the time window of both (s).
        turn_limit, turn_window = 0.5, 2.0
        while now - self._turn_errors[0][0] > turn_window * SECOND:
            self._turn_errors.popleft()
        if abs(error := sum(turn for _, turn in self._turn_errors)) > turn_limit:
            yield "steering", f"turned {error:+.2f} rad off within {turn_window:g} s"

    def _held(self, seen: Observation) -> bool:
        return len(seen.target) > 1 and any(map(self._world.shaft_blocked, range(len(seen.target))))

    def _asked(self, seen: Observation) -> float:
        """Return the commanded yaw rate at the true pace (rad/s)."""
        chassis, angles = self._steering.chassis, self._steering.angles
        if len(seen.target) == 1:
            return chassis.bicycle.body_twist(seen.truth.v, *angles)[2]
        if any(seen.target):
            self._course = chassis.twist(chassis.input_speeds(seen.target, *angles), *angles)
        asked = self._pace(self._course)
        return self._course[2] * min(self._pace(seen.twist) / asked, 1.0) if asked > 0 else 0.0

    def _pace(self, twist: Twist2) -> float:
        """Return the magnitude of a motion: speed of the base, or of the wheels that turn it (m/s)."""
        return max(math.hypot(*twist[:2]), abs(twist[2]) * self._steering.chassis.bicycle.track / 2)


class _Silence:
    """A truck stops when an indispensable device is silent.

    Args:
        devices: (role, wire, maximum silence in s) of the indispensable devices.
    """

    def __init__(self, devices: Iterable[tuple[str, WireTap, float]]) -> None:
        self._devices = list(devices)

    def __call__(self, seen: Observation) -> Broken:
        for role, tap, longest in self._devices:
            silent = 0.0 if tap.heard is None else (seen.now - tap.heard) / SECOND
            if silent > longest + STOPS_WITHIN and abs(seen.truth.v) > STANDING_SPEED:
                yield "silence", f"{seen.truth.v:.3f} m/s though {role} is silent for {silent:.2f} s"


class _Battery:
    """A truck with a stale battery measurement drives slowly or not at all.

    Args:
        tap: wire of the servo controller, whose analog input measures the battery.
        channel: channel of the input.
        limits: maximum age of the measurement (s), and the speed limit after that (m/s).
    """

    def __init__(self, tap: WireTap, channel: int, limits: tuple[float, float]) -> None:
        self._tap, self._channel = tap, channel
        self._longest, self._speed = limits
        self._asked: int | None = None
        self._measured: int | None = None

    def ask(self, channel: int, instant: int) -> None:
        """Record that the host requests the position or voltage of a channel at ``instant`` (ns)."""
        if channel == self._channel:
            self._asked = instant

    def __call__(self, seen: Observation) -> Broken:
        if self._asked is not None and self._tap.heard is not None and self._tap.heard >= self._asked:
            self._measured, self._asked = self._asked, None
        if self._measured is None:
            return
        unknown = (seen.now - self._measured) / SECOND
        if unknown > self._longest + STOPS_WITHIN and abs(seen.truth.v) > self._speed * SPEED_MARGIN + STANDING_SPEED:
            yield "battery", f"{seen.truth.v:.3f} m/s though the battery was not measured for {unknown:.1f} s"


class _Ahead:
    """Forward driving: obstacles ahead within the truck's width, and obstacles on its arc.

    Args:
        config: configuration of the truck.
        world: its obstacles are checked from the camera's position.
    """

    def __init__(self, config: SimulatedTruckConfig, world: World) -> None:
        truck = config.sim.world.truck
        self._world = world
        self._camera = config.sim.world.camera.x
        self._width, self._half = truck.width, truck.length / 2
        self._braking = config.gate.obstacle.deceleration
        self._fast = Duration()
        self._count = 0

    def __call__(self, seen: Observation) -> Broken:
        self._count += 1
        if self._count % 5 != 1:  # samples between two checks ahead: a check casts rays
            return
        now, truth = seen.now, seen.truth
        if truth.v <= 2 * STANDING_SPEED:
            self._fast.update(now, so=False)
            return
        ranges = np.minimum(self._world.view.ranges(now, FAN), 100.0)  # range without a return (m)
        ahead, aside = self._camera + ranges * np.cos(FAN), ranges * np.sin(FAN)
        room = float(ahead[np.abs(aside) < self._width / 2].min(initial=math.inf)) - self._half
        if room < 0.03:  # minimum distance to an obstacle ahead (m)
            yield "obstacle", f"{truth.v:.3f} m/s towards something {room:.3f} m ahead"
        room = self._room(truth.wz / truth.v, ahead, aside)
        # 0.4: maximum time that a truck is too fast for the free distance ahead (s): an obstacle may enter its path
        if self._fast.update(now, so=truth.v**2 / (2 * self._braking) > room) > 0.4:
            yield "braking", f"{truth.v:.3f} m/s with something on its way in {room:.3f} m"

    def _room(self, curvature: float, ahead: Array, aside: Array) -> float:
        """Return the distance along the current arc to the first of these points (m)."""
        turn = ROOM * curvature
        at_x, at_y = ROOM * np.sinc(turn / math.pi), ROOM * np.sinc(turn / 2 / math.pi) * np.sin(turn / 2)
        dx, dy = ahead - at_x[:, None], aside - at_y[:, None]
        c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
        along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
        met = ((along < self._half) & (across < self._width / 2)).any(axis=1)
        return float(ROOM[met].min(initial=math.inf))


def _contact(seen: Observation) -> Broken:
    """The truck does not hit anything."""
    if seen.truth.stuck:
        yield "contact", "ran into something"


def _servo_wire(
    config: SimulatedTruckConfig, tap: WireTap, world: World, clock: Clock
) -> tuple[ServoWire, tuple[Rule, ...]]:
    """Return the wire of the servo controller, and the rules for its other measurements."""
    assert config.devices.steering is not None
    driver, gate = config.devices.steering.driver, config.gate
    if kind_of(driver).name != MAESTRO:
        return _SentPulses(tap, world, (servo.channel for servo in driver.servos), clock), ()
    if driver.battery is None:
        return _MaestroWire(tap, crc=driver.use_crc, asked=lambda _channel, _instant: None), ()
    limits = gate.battery.stale_after, 0.0 if gate.battery.critical else gate.battery_low_speed
    battery = _Battery(tap, driver.battery.channel, limits)
    return _MaestroWire(tap, crc=driver.use_crc, asked=battery.ask), (battery,)


class Observer:
    """Checks the invariants of one truck, and measures its reactions; ``begin`` and ``end_fault`` enclose one fault.

    Args:
        config: configuration of the truck, for its limits.
        world: the simulated world.
        ports: ports to tap: of the motors, and of steering, lidar and compass if present.
        clock: source of time.
    """

    def __init__(
        self, config: SimulatedTruckConfig, world: World, ports: Mapping[str, MemoryPort], clock: Clock
    ) -> None:
        self._world = world
        self._clock = clock
        taps: dict[str, WireTap] = {r: WireTap(ports[r], clock) for r in WIRES if r in ports}
        self._taps = taps
        self._motors = _motor_wires(config, taps, world, clock)
        self._fresh: list[tuple[int, int, float]] = []
        """Targets not yet passed to the rules."""
        self._stops: dict[int, int] = {}
        """Time of the first stop bytes of each shaft since the fault (ns)."""
        gate = config.gate
        self._steering = _PulsedSteering(config)
        chassis = self._steering.chassis
        self._target = [0.0] * len(chassis.shafts)
        self._standstill = _Standstill()
        self._turning = _Turning(self._steering, world)
        self._servos: ServoWire | None = None
        rules: list[Rule] = [
            self._standstill,
            _Speeds(chassis, gate.reverse_speed, gate.speed),
            _Ramp(_accelerations(chassis, gate)),
            _HeldShaft(world),
        ]
        if config.devices.steering is not None:
            rules.append(_Pulses(config, self._steering))
            self._servos, battery = _servo_wire(config, taps[DeviceRole.STEERING], world, clock)
            rules += battery
        rules += [self._turning, _Silence(_indispensable(config, taps)), _contact]
        if config.devices.lidar is not None:
            rules.append(_Ahead(config, world))
        self._rules = tuple(rules)
        self._violations: dict[str, Violation] = {}
        self.speed = 0.0
        """True speed (m/s)."""

    @property
    def drive(self) -> WireTap:
        """Wire of the first motor controller."""
        return self._motors[0].tap

    async def run(self) -> None:
        """Observe at 100 Hz until cancelled."""
        due = self._clock.now()
        while True:
            self._observe()
            due += TRUTH_PERIOD
            await self._clock.sleep_until(due)

    # Called by the drill

    def disarm(self) -> None:
        """Record that the operator disarms: the truck must stand soon."""
        self._standstill.disarmed = self._clock.now()

    def arm(self) -> None:
        """Record that the operator arms: the truck may move."""
        self._standstill.disarmed = None

    def estop(self) -> None:
        """Record the operator's emergency stop: the truck must stand soon, until ``reset``."""
        self._standstill.estopped = self._standstill.estopped or self._clock.now()

    def reset(self) -> None:
        """Record the reset of the emergency stop: an armed truck may move."""
        self._standstill.estopped = None

    def begin(self, *, stops: bool, disarms: bool = False) -> None:
        """Start a fault; with ``stops`` the truck must stand soon, with ``disarms`` it may not restart by itself."""
        self._observe()
        self._standstill.begin(self._clock.now(), must_stop=stops, disarms=disarms)
        self._turning.begin()
        self._violations.clear()
        self._stops.clear()
        for motors in self._motors:
            motors.forget()

    def end_fault(self) -> None:
        """End the fault."""
        self._standstill.must_stop = self._standstill.disarms = False

    def violations(self) -> tuple[Violation, ...]:
        """Violations since ``begin``: the first of each rule."""
        return tuple(self._violations.values())

    @property
    def top_speed(self) -> float:
        """Maximum true speed since the start of the fault (m/s)."""
        return self._standstill.top_speed

    def stop_bytes_after(self) -> float | None:
        """Time from the fault until stop bytes have reached every motor (s)."""
        self._read_motors()
        if len(self._stops) < len(self._target):
            return None
        return (max(self._stops.values()) - self._standstill.began) / SECOND

    def standstill_after(self) -> float | None:
        """Time from the fault to standstill (s)."""
        stood = self._standstill.stood
        return None if stood is None else (stood - self._standstill.began) / SECOND

    def before_something(self) -> bool:
        """Whether an obstacle ahead is so near that the truck may rightly refuse to start."""
        # 0.6: distance from the camera within which an obstacle may keep the truck from starting (m)
        return bool(self._world.view.ranges(self._clock.now(), FAN).min() < 0.6)

    def metres(self) -> float:
        """True distance travelled since the fault, to standstill or until the call (m)."""
        return self._standstill.metres()

    # Observations

    def _observe(self) -> None:
        now = self._clock.now()
        truth = self._world.truth(now)
        self.speed = truth.v
        self._read_motors()
        targets, self._fresh = tuple(self._fresh), []
        for _, shaft, speed in targets:
            self._target[shaft] = speed
        twist = self._world.plant.twist
        pulses = () if self._servos is None else tuple(self._servos.read())
        seen = Observation(now, truth, twist, targets, tuple(self._target), pulses)
        for rule in self._rules:
            for name, text in rule(seen):
                self._violations.setdefault(name, Violation((now - self._standstill.began) / SECOND, name, text))

    def _read_motors(self) -> None:
        for motors in self._motors:
            for instant, shaft, speed in motors.read():
                self._fresh.append((instant, shaft, speed))
                if speed == 0 and instant >= self._standstill.began:
                    self._stops.setdefault(shaft, instant)


def _indispensable(config: SimulatedTruckConfig, taps: Mapping[str, WireTap]) -> Iterator[tuple[str, WireTap, float]]:
    """Yield the wires of the devices without which the truck may not drive: role, wire and maximum silence (s).

    Without the deadman line nothing stops an unreachable EPOS; stepper controllers have their own watchdog.
    """
    gate = config.gate
    limits: dict[str, SensorLimit | None] = {
        **dict.fromkeys(map(str, MOTORS), gate.drive),
        DeviceRole.STEERING.value: gate.steering,
        DeviceRole.LIDAR.value: gate.scan,
        DeviceRole.COMPASS.value: gate.attitude,
    }
    for role, tap in taps.items():
        limit = limits[role]
        if limit is not None and limit.critical and (role not in SHAFTS or config.sim.deadman_wired):
            yield role, tap, limit.stale_after
