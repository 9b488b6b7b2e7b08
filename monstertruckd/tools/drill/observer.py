"""The observer of a drill: checks invariants by the bytes on two wires and the world's truth, not by the daemon's word.

It sees the wires of drive, steering, lidar and compass, the true state of the truck and the operator's orders.
A hundred times a second each rule says what is unsafe in an ``Observation``.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control, FrameError, Opcode, decode_body, join
from monstertruck_drivers.maestro.protocol import Code, Decoder, ServoCommand
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_schemas.roles import DeviceRole
from monstertruck_sim.world.plant import TruthState
from monstertruck_sim.world.world import World
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

PERIOD: Final = SECOND // 100
AT_REST: Final = 0.01
"""True speed of a truck that stands, m/s."""
STOPS_WITHIN: Final = 0.6
"""Seconds from any fault that must stop the truck, or from a disarm order, to standstill."""
CLOSEST: Final = 0.03
"""Least distance, m, of anything that is driven towards."""
NEAR: Final = 0.6
"""Distance from the camera, m, within which an obstacle may keep the truck from starting."""
SPEED_MARGIN: Final = 1.05
"""True speed over the greatest commanded one: the motor's overshoot."""
ANGLE_MARGIN: Final = 0.01
"""Rounding of pulses, rad."""
TURN_ERROR: Final = 0.5
"""Greatest difference of the true turn from the one the pulses ask for within ``TURN_WINDOW`` s, rad."""
TURN_WINDOW: Final = 2.0
FAN: Final = np.linspace(-1.2, 1.2, 49)
"""Directions of the distances that are checked ahead, rad."""
FAR: Final = 100.0
"""Distance of what is not there, m."""
HELD_WITHIN: Final = 1.0
"""Seconds for which a motor may be commanded to turn a shaft that is held."""
RAMP_SLACK: Final = 0.1
"""Seconds by which the bytes on the wire may be ahead of the ramp: ticks and exchanges have no common beat."""
STOPS_ASKING_WITHIN: Final = 0.1
"""Seconds after an order that stops from which on no bytes ask a moving truck for a speed."""
BRAKES_WITHIN: Final = 0.4
"""Seconds for which a truck may be too fast for the room before it: something may step in its way."""
LOOKS: Final = 5
"""Samples from one look ahead to the next: it casts rays."""
ROOM: Final = np.linspace(0.0, 0.5, 26)
"""Ways ahead of which the ground is looked at, m."""
REVERSES_BELOW: Final = 0.05
"""True speed, m/s, from which on a motor may not be asked to turn the other way."""
WIRES: Final = (DeviceRole.DRIVE, DeviceRole.STEERING, DeviceRole.LIDAR, DeviceRole.COMPASS)
STOP_CONTROLS: Final = frozenset((Control.QUICK_STOP, Control.DISABLE_VOLTAGE, Control.HALT))


@dataclass(frozen=True, slots=True)
class Violation:
    """Something unsafe."""

    seconds: float
    """Since the fault."""
    rule: str
    text: str


class WireTap:
    """Everything that passes a device's cable; stays with the device when it is plugged in elsewhere.

    Args:
        port: where the device is plugged in.
        clock: time.
    """

    def __init__(self, port: MemoryPort, clock: Clock) -> None:
        self.to_device: list[tuple[int, bytes]] = []
        """(ns, bytes) as the last of them reached the device."""
        self.to_host: list[tuple[int, bytes]] = []
        """(ns, bytes) as the last of them reached the host."""
        self.heard: int | None = None
        """When the host last got any, ns."""
        self._clock = clock
        port.device.on_bytes = self._pass

    def _pass(self, to_device: bool, data: bytes) -> None:
        now = self._clock.now()
        (self.to_device if to_device else self.to_host).append((now, data))
        if not to_device:
            self.heard = now


def written(tap: WireTap, since: int = 0) -> list[tuple[int, int, int]]:
    """Objects the host wrote to an EPOS: (ns, index, raw value); whatever is not a whole frame is skipped."""
    return _writes(item for item in tap.to_device if item[0] >= since)


def _writes(received: Iterable[tuple[int, bytes]]) -> list[tuple[int, int, int]]:
    found = []
    for instant, data in received:
        with suppress(FrameError):
            words = decode_body(Opcode.WRITE, data).words
            if len(words) == 4:
                found.append((instant, words[0], join(words[2], words[3])))
    return found


def stop_bytes(tap: WireTap, since: int) -> int | None:
    """Instant at which the first write that stops the motor has reached an EPOS: target 0, quick stop, halt, off."""
    for instant, index, value in written(tap, since):
        target = index == od.TARGET_VELOCITY.index and value == 0
        if target or (index == od.CONTROLWORD.index and value in STOP_CONTROLS):
            return instant
    return None


@dataclass(frozen=True, slots=True)
class Observation:
    """What is seen at one instant."""

    now: int
    """Ns."""
    truth: TruthState
    targets: tuple[tuple[int, float], ...]
    """Speeds that bytes since the one before ask the motor for: (ns, m/s over ground); 0 = any stop."""
    target: float
    """Speed that the newest bytes ask for, m/s."""
    pulses: tuple[tuple[int, float], ...]
    """Pulses that bytes since the one before ask the servos for: (channel, us)."""


Broken = Iterator[tuple[str, str]]
"""Names of the rules that an observation breaks, each with what was seen."""

Rule = Callable[[Observation], Broken]
"""One subject of the observer; gets every observation once, in order."""


class Duration:
    """For how long something has been so without a break."""

    def __init__(self) -> None:
        self._since: int | None = None

    def update(self, now: int, *, so: bool) -> float:
        """Seconds at ``now`` (ns); 0 while it is not so."""
        self._since = (now if self._since is None else self._since) if so else None
        return 0.0 if self._since is None else (now - self._since) / SECOND


class _Standstill:
    """The truck stands where operator or fault demand it; and how far and for how long it went on."""

    def __init__(self) -> None:
        self.began = 0
        """Of the fault, ns."""
        self.must_stop = False
        """The fault must stop the truck."""
        self.disarms = False
        """After the fault the truck may not set off again by itself."""
        self.disarmed: int | None = None
        """When the operator disarmed it, ns."""
        self.estopped: int | None = None
        """When the operator stopped it, ns, until the reset."""
        self.stood: int | None = None
        """When it first stood after the fault, ns."""
        self.top_speed = 0.0
        """Greatest true speed since the fault, m/s."""
        self._path: list[tuple[float, float]] = []

    def begin(self, now: int, *, must_stop: bool, disarms: bool) -> None:
        """A fault begins."""
        self.began, self.must_stop, self.disarms = now, must_stop, disarms
        self.stood, self.top_speed = None, 0.0
        self._path.clear()

    def metres(self) -> float:
        """Truly travelled since the fault, m, to standstill or until the call."""
        return sum(math.dist(a, b) for a, b in pairwise(self._path))

    def __call__(self, seen: Observation) -> Broken:
        now, speed = seen.now, seen.truth.v
        self.top_speed = max(self.top_speed, abs(speed))
        moving = abs(speed) > AT_REST
        if self.stood is None:
            self._path.append((seen.truth.x, seen.truth.y))
            if not moving:
                self.stood = now
        if not moving:
            return
        ordered = min((at for at in (self.disarmed, self.estopped) if at is not None), default=now)
        if now > ordered + STOPS_ASKING_WITHIN * SECOND and any(asked for _, asked in seen.targets):
            yield "stopping bytes", f"{seen.target:.3f} m/s asked for at {speed:.3f} m/s though it was ordered to stop"
        limit = round(STOPS_WITHIN * SECOND)
        if self.disarmed is not None and now > self.disarmed + limit:
            yield "disarmed", f"{speed:.3f} m/s though disarmed"
        if self.estopped is not None and now > self.estopped + limit:
            yield "emergency stop", f"{speed:.3f} m/s though stopped and not reset"
        if self.must_stop and now > self.began + limit:
            yield "stop", f"{speed:.3f} m/s: must stand"
        if self.disarms and self.stood is not None:
            yield "unarmed", f"{speed:.3f} m/s: set off again though nobody armed it"


class _Speeds:
    """Speeds, true and asked for, stay within the limits; nobody asks for the other direction before standstill.

    Args:
        backwards: limit, m/s.
        forwards: limit, m/s.
    """

    def __init__(self, backwards: float, forwards: float) -> None:
        self._limits = backwards, forwards

    def __call__(self, seen: Observation) -> Broken:
        speed = seen.truth.v
        if abs(speed) > (most := self._limits[speed > 0]) * SPEED_MARGIN:
            yield "speed", f"{speed:.3f} m/s: at most {most:.3f}"
        for _, asked in seen.targets:
            if abs(asked) > (most := self._limits[asked > 0]) * 1.01:
                yield "speed bytes", f"{asked:.3f} m/s: at most {most:.3f}"
            if abs(speed) > REVERSES_BELOW and asked * speed < 0:
                yield "reversal bytes", f"{asked:.3f} m/s at {speed:.3f} m/s"


class _Ramp:
    """Bytes ask for a speed no sooner than the ramp from the one before.

    Args:
        acceleration: of the ramp, m/s^2.
    """

    def __init__(self, acceleration: float) -> None:
        self._acceleration = acceleration
        self._newest: tuple[float, int] | None = None
        """Greatest speed that the ramp allows the bytes to ask for, m/s, and when it did, ns; None = it begins anew."""

    def __call__(self, seen: Observation) -> Broken:
        for instant, speed in seen.targets:
            if speed == 0:  # a drive that was stopped for a moment may go on as fast as before
                self._newest = None
                continue
            ramp = abs(speed) + self._acceleration * RAMP_SLACK
            if self._newest is not None:
                before, then = self._newest
                allowed = before + self._acceleration * (instant - then) / SECOND
                if abs(speed) > allowed * 1.01:
                    yield "ramp bytes", f"{speed:.3f} m/s: at most {allowed:.3f} so soon"
                ramp = min(ramp, allowed)
            self._newest = ramp, instant


class _HeldShaft:
    """A motor that cannot turn is not driven on."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._held = Duration()

    def __call__(self, seen: Observation) -> Broken:
        if self._held.update(seen.now, so=seen.target != 0 and self._world.shaft_blocked()) > HELD_WITHIN:
            yield "held shaft", f"{seen.target:.3f} m/s asked for though the shaft is held"


class _Pulses:
    """Servos are asked for angles within their limits and those of the axles, and the truck turns as they ask.

    Args:
        config: of the truck, with a steering device.
    """

    def __init__(self, config: SimulatedTruckConfig) -> None:
        assert config.devices.steering is not None
        truck = config.sim.world.truck
        self._limits = {servo.channel: servo for servo in config.devices.steering.driver.servos}
        self._chassis = truck.chassis()
        self._angle = config.gate.angle + ANGLE_MARGIN
        self._models = {servo.channel: servo for servo in (truck.front_servo, truck.rear_servo)}
        self._arms = dict.fromkeys(self._models, 0.0)
        """Servo angles that the newest pulses ask for, rad."""
        self._turn_errors: deque[tuple[int, float]] = deque()

    def begin(self) -> None:
        """Turns before do not count."""
        self._turn_errors.clear()

    def __call__(self, seen: Observation) -> Broken:
        for channel, pulse_us in seen.pulses:
            yield from self._check_pulse(channel, pulse_us)
        yield from self._check_turn(seen.now, seen.truth)

    def _check_pulse(self, channel: int, pulse_us: float) -> Broken:
        limits, model = self._limits.get(channel), self._models.get(channel)
        if limits is not None and not limits.min_us - 0.5 <= pulse_us <= limits.max_us + 0.5:
            yield "pulse bytes", f"{pulse_us:.1f} us: {limits.min_us:g} to {limits.max_us:g}"
        if model is not None:
            self._arms[channel] = math.radians((pulse_us - model.centre_us) / model.us_per_degree)
        if (angle := max(map(abs, self._steering()))) > self._angle:
            yield "angle bytes", f"axle at {angle:.3f} rad: at most {self._angle:.3f}"

    def _check_turn(self, now: int, truth: TruthState) -> Broken:
        """The true rate of turn against the one that the pulses ask for, while the truck drives."""
        asked = self._chassis.bicycle.body_twist(truth.v, *self._steering())[2]
        self._turn_errors.append((now, (truth.wz - asked) * PERIOD / SECOND))
        while now - self._turn_errors[0][0] > TURN_WINDOW * SECOND:
            self._turn_errors.popleft()
        if abs(error := sum(turn for _, turn in self._turn_errors)) > TURN_ERROR:
            yield "steering", f"turned {error:+.2f} rad off within {TURN_WINDOW:g} s"

    def _steering(self) -> tuple[float, ...]:
        """Axle angles that the newest pulses ask for, rad."""
        return self._chassis.steering(*self._arms.values())


class _Silence:
    """A truck stops when a device is silent without which it may not drive.

    Args:
        devices: (role, wire, for how long it may be silent, s) of those devices.
    """

    def __init__(self, devices: Iterable[tuple[str, WireTap, float]]) -> None:
        self._devices = list(devices)

    def __call__(self, seen: Observation) -> Broken:
        for role, tap, longest in self._devices:
            silent = 0.0 if tap.heard is None else (seen.now - tap.heard) / SECOND
            if silent > longest + STOPS_WITHIN and abs(seen.truth.v) > AT_REST:
                yield "silence", f"{seen.truth.v:.3f} m/s though {role} is silent for {silent:.2f} s"


class _Battery:
    """A truck whose battery was measured, and is no longer, drives slowly, or not at all.

    Args:
        tap: wire of the servo controller, whose analog input measures it.
        channel: of that input.
        limits: how long it may be unmeasured, s, and the speed limit then, m/s.
    """

    def __init__(self, tap: WireTap, channel: int, limits: tuple[float, float]) -> None:
        self._tap, self._channel = tap, channel
        self._longest, self._speed = limits
        self._asked: int | None = None
        self._measured: int | None = None

    def ask(self, channel: int, instant: int) -> None:
        """The host asks for the position or voltage of a channel at ``instant``, ns."""
        if channel == self._channel:
            self._asked = instant

    def __call__(self, seen: Observation) -> Broken:
        if self._asked is not None and self._tap.heard is not None and self._tap.heard >= self._asked:
            self._measured, self._asked = self._asked, None
        if self._measured is None:
            return
        unknown = (seen.now - self._measured) / SECOND
        if unknown > self._longest + STOPS_WITHIN and abs(seen.truth.v) > self._speed * SPEED_MARGIN + AT_REST:
            yield "battery", f"{seen.truth.v:.3f} m/s though the battery was not measured for {unknown:.1f} s"


class _Ahead:
    """Driving forwards: what is before the width of the truck, and what is in its way on its arc.

    Args:
        config: of the truck.
        world: whose obstacles are looked at from the camera's place.
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
        if self._count % LOOKS != 1:
            return
        now, truth = seen.now, seen.truth
        if truth.v <= 2 * AT_REST:
            self._fast.update(now, so=False)
            return
        ranges = np.minimum(self._world.view.ranges(now, FAN), FAR)
        ahead, aside = self._camera + ranges * np.cos(FAN), ranges * np.sin(FAN)
        room = float(ahead[np.abs(aside) < self._width / 2].min(initial=math.inf)) - self._half
        if room < CLOSEST:
            yield "obstacle", f"{truth.v:.3f} m/s towards something {room:.3f} m ahead"
        room = self._room(truth.wz / truth.v, ahead, aside)
        if self._fast.update(now, so=truth.v**2 / (2 * self._braking) > room) > BRAKES_WITHIN:
            yield "braking", f"{truth.v:.3f} m/s with something on its way in {room:.3f} m"

    def _room(self, curvature: float, ahead: Array, aside: Array) -> float:
        """Way along the present arc to the first of these points, m."""
        turn = ROOM * curvature
        at_x, at_y = ROOM * np.sinc(turn / math.pi), ROOM * np.sinc(turn / 2 / math.pi) * np.sin(turn / 2)
        dx, dy = ahead - at_x[:, None], aside - at_y[:, None]
        c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
        along, across = np.abs(c * dx + s * dy), np.abs(c * dy - s * dx)
        met = ((along < self._half) & (across < self._width / 2)).any(axis=1)
        return float(ROOM[met].min(initial=math.inf))


def _contact(seen: Observation) -> Broken:
    """The truck runs into nothing."""
    if seen.truth.stuck:
        yield "contact", "ran into something"


class Observer:
    """Checks the invariants of one truck, and measures how it reacts; ``begin`` and ``end_fault`` bound one fault.

    Args:
        config: of the truck, for its limits.
        world: the simulated world.
        ports: whose wires are tapped: drive and steering, and those of lidar and compass where it has them.
        clock: time.
    """

    def __init__(
        self, config: SimulatedTruckConfig, world: World, ports: Mapping[str, MemoryPort], clock: Clock
    ) -> None:
        assert config.devices.steering is not None
        self._world = world
        self._clock = clock
        taps: dict[str, WireTap] = {r: WireTap(ports[r], clock) for r in WIRES if r in ports}
        self.drive, self._servos = taps[DeviceRole.DRIVE], taps[DeviceRole.STEERING]
        self._maestro = Decoder(crc=config.devices.steering.driver.use_crc)
        motor = config.sim.world.truck.motor
        drivetrain = DriveTrain(motor.ratio, config.sim.world.truck.wheel_radius)
        self._rpm = drivetrain.motor_rate(1.0) * 30 / math.pi * (-1 if motor.inverted else 1)
        """Of the motor at 1 m/s, in the controller's sign."""
        self._read = 0
        """How much of the drive's bytes was checked."""
        self._target = 0.0
        gate = config.gate
        self._standstill = _Standstill()
        self._pulses = _Pulses(config)
        self._battery: _Battery | None = None
        if (pack := config.devices.steering.driver.battery) is not None:
            limits = gate.battery.stale_after, 0.0 if gate.battery.critical else gate.battery_low_speed
            self._battery = _Battery(self._servos, pack.channel, limits)
        self._rules: tuple[Rule, ...] = (
            self._standstill,
            _Speeds(gate.reverse_speed, gate.speed),
            _Ramp(gate.acceleration),
            _HeldShaft(world),
            self._pulses,
            _Silence(_indispensable(config, taps)),
            _Ahead(config, world),
            _contact,
            *(() if self._battery is None else (self._battery,)),
        )
        self._violations: dict[str, Violation] = {}
        self.speed = 0.0
        """True speed, m/s."""

    async def run(self) -> None:
        """Observe a hundred times a second until cancelled."""
        due = self._clock.now()
        while True:
            self._observe()
            due += PERIOD
            await self._clock.sleep_until(due)

    # Called by the drill

    def disarm(self) -> None:
        """The operator disarms: the truck must stand soon."""
        self._standstill.disarmed = self._clock.now()

    def arm(self) -> None:
        """The operator arms: the truck may move."""
        self._standstill.disarmed = None

    def estop(self) -> None:
        """The operator stops: the truck must stand soon, until ``reset``."""
        self._standstill.estopped = self._standstill.estopped or self._clock.now()

    def reset(self) -> None:
        """The operator resets the emergency stop: an armed truck may move."""
        self._standstill.estopped = None

    def begin(self, *, stops: bool, disarms: bool = False) -> None:
        """A fault begins; with ``stops`` the truck must stand soon, with ``disarms`` not set off again by itself."""
        self._observe()
        self._standstill.begin(self._clock.now(), must_stop=stops, disarms=disarms)
        self._pulses.begin()
        self._violations.clear()
        self._read = 0
        self.drive.to_device.clear()
        self.drive.to_host.clear()

    def end_fault(self) -> None:
        """The fault is over."""
        self._standstill.must_stop = self._standstill.disarms = False

    def violations(self) -> tuple[Violation, ...]:
        """What was unsafe since ``begin``: the first case of every rule."""
        return tuple(self._violations.values())

    @property
    def top_speed(self) -> float:
        """Greatest true speed since the fault began, m/s."""
        return self._standstill.top_speed

    def stop_bytes_after(self) -> float | None:
        """Seconds from the fault to the first bytes that stop the motor."""
        began = self._standstill.began
        instant = stop_bytes(self.drive, began)
        return None if instant is None else (instant - began) / SECOND

    def standstill_after(self) -> float | None:
        """Seconds from the fault to standstill."""
        stood = self._standstill.stood
        return None if stood is None else (stood - self._standstill.began) / SECOND

    def before_something(self) -> bool:
        """Whether an obstacle in front is so near that the truck may rightly not start."""
        return bool(self._world.view.ranges(self._clock.now(), FAN).min() < NEAR)

    def metres(self) -> float:
        """Truly travelled since the fault, m, to standstill or until the call."""
        return self._standstill.metres()

    # What is seen

    def _observe(self) -> None:
        now = self._clock.now()
        truth = self._world.truth(now)
        self.speed = truth.v
        targets = tuple(self._new_targets())
        if targets:
            self._target = targets[-1][1]
        seen = Observation(now, truth, targets, self._target, tuple(self._new_pulses()))
        for rule in self._rules:
            for name, text in rule(seen):
                self._violations.setdefault(name, Violation((now - self._standstill.began) / SECOND, name, text))

    def _new_targets(self) -> Iterator[tuple[int, float]]:
        fresh = self.drive.to_device[self._read :]
        self._read += len(fresh)
        for instant, index, value in _writes(fresh):
            if index == od.TARGET_VELOCITY.index:
                yield instant, (value - (1 << 32) if value >= 1 << 31 else value) / self._rpm
            elif index == od.CONTROLWORD.index and value in STOP_CONTROLS:
                yield instant, 0.0

    def _new_pulses(self) -> Iterator[tuple[int, float]]:
        received, self._servos.to_device[:] = list(self._servos.to_device), []
        self._servos.to_host.clear()
        for instant, data in received:
            for command in self._maestro.feed(data):
                if not isinstance(command, ServoCommand):
                    continue
                if command.code is Code.SET_TARGET and command.value:
                    yield command.data[0], command.value / 4
                elif command.code is Code.GET_POSITION and self._battery is not None:
                    self._battery.ask(command.data[0], instant)


def _indispensable(config: SimulatedTruckConfig, taps: Mapping[str, WireTap]) -> Iterator[tuple[str, WireTap, float]]:
    """Wires of what the truck may not drive without: role, wire, and for how long it may be silent, s.

    Without the deadman line nothing stops a drive that cannot be reached.
    """
    gate = config.gate
    limits = dict(zip(map(str, WIRES), (gate.drive, gate.steering, gate.scan, gate.attitude), strict=True))
    for role, tap in taps.items():
        if limits[role].critical and (role != DeviceRole.DRIVE or config.sim.deadman_wired):
            yield role, tap, limits[role].stale_after
