"""The observer of a drill: checks invariants by the bytes on two wires and the world's truth, not by the daemon's word.

It sees the wires of drive, steering, lidar and compass, the true state of the truck and the operator's orders.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control, FrameError, Opcode, decode_body, join
from monstertruck_drivers.maestro.protocol import Code, Decoder, ServoCommand
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_sim.world.config import ServoModelConfig
from monstertruck_sim.world.truck_plant import TruthState
from monstertruck_sim.world.world import World
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

SAMPLE: Final = SECOND // 100
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
BRAKES_WITHIN: Final = 0.4
"""Seconds for which a truck may be too fast for the room before it: something may step in its way."""
ROOM: Final = np.linspace(0.0, 0.5, 26)
"""Ways ahead of which the ground is looked at, m."""
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
        self.drive = WireTap(ports["drive"], clock)
        self._steering = WireTap(ports["steering"], clock)
        gate = config.gate
        wires = {"drive": self.drive, "steering": self._steering}
        wires |= {role: WireTap(ports[role], clock) for role in ("lidar", "compass") if role in ports}
        limits = {"drive": gate.drive, "steering": gate.steering, "lidar": gate.scan, "compass": gate.attitude}
        unreachable = set() if config.sim.deadman_wired else {"drive"}
        self._senses = [
            (role, tap, limits[role].stale_after)
            for role, tap in wires.items()
            if limits[role].critical and role not in unreachable
        ]
        """Wires of what the truck may not drive without: device, wire, and for how long it may be silent, s; without
        the deadman line nothing stops a drive that cannot be reached."""
        self._maestro = Decoder(crc=config.devices.steering.driver.use_crc)
        self._truck = truck = config.sim.world.truck
        self._chassis = truck.chassis()
        self._angle = config.gate.angle + ANGLE_MARGIN
        self._speeds = gate.reverse_speed, gate.speed
        """Greatest backwards and forwards, m/s."""
        self._braking = gate.obstacle.deceleration
        self._camera = config.sim.world.camera.x
        drivetrain = DriveTrain(truck.motor.ratio, truck.wheel_radius)
        self._rpm = drivetrain.motor_rate(1.0) * 30 / math.pi * (-1 if truck.motor.inverted else 1)
        """Of the motor at 1 m/s, in the controller's sign."""
        self._acceleration = gate.acceleration
        self._ramp: tuple[float, int] | None = None
        """Greatest speed that the ramp allows the bytes to ask for, m/s, and when it did, ns; None = it begins anew."""
        self._servos = {servo.channel: servo for servo in config.devices.steering.driver.servos}
        self._pulses = {truck.front_servo.channel: 0.0, truck.rear_servo.channel: 0.0}
        """Servo angles that the newest pulses ask for, rad."""
        self._turn_errors: deque[tuple[int, float]] = deque()
        self._target = 0
        """Motor speed that the newest bytes ask for, rpm."""
        self._held: int | None = None
        """Since when the motor has been asked to turn a shaft that is held, ns."""
        self._fast: int | None = None
        """Since when the truck has been too fast for the room before it, ns."""
        self._disarmed: int | None = None
        self._estopped: int | None = None
        self._began = 0
        self._read = 0
        """How much of the drive's bytes was checked."""
        self._must_stop = False
        self._disarms = False
        self._stood: int | None = None
        self._path: list[tuple[float, float]] = []
        self.top_speed = 0.0
        """Greatest true speed since the fault began, m/s."""
        self._violations: dict[str, Violation] = {}
        self.speed = 0.0
        """True speed, m/s."""

    async def run(self) -> None:
        """Sample a hundred times a second until cancelled."""
        due = self._clock.now()
        turn = 0
        while True:
            now = self._clock.now()
            truth = self._world.truth(now)
            self.speed = truth.v
            self.top_speed = max(self.top_speed, abs(truth.v))
            self._check_motion(now, truth)
            self._check_bytes(now)
            self._check_shaft(now)
            self._check_steering(now, truth)
            self._check_senses(now)
            if turn % 5 == 0:
                self._check_ahead(now, truth)
            turn += 1
            due += SAMPLE
            await self._clock.sleep_until(due)

    # Called by the drill

    def disarm(self) -> None:
        """The operator disarms: the truck must stand soon."""
        self._disarmed = self._clock.now()

    def arm(self) -> None:
        """The operator arms: the truck may move."""
        self._disarmed = None

    def estop(self) -> None:
        """The operator stops: the truck must stand soon, until ``reset``."""
        self._estopped = self._estopped or self._clock.now()

    def reset(self) -> None:
        """The operator resets the emergency stop: an armed truck may move."""
        self._estopped = None

    def begin(self, *, stops: bool, disarms: bool = False) -> None:
        """A fault begins; with ``stops`` the truck must stand soon, with ``disarms`` not set off again by itself."""
        self._began = self._clock.now()
        self._must_stop, self._disarms = stops, disarms
        self._stood = None
        self._path.clear()
        self.top_speed = 0.0
        self._turn_errors.clear()
        self._check_bytes(self._began)
        self._violations.clear()
        self._read = 0
        self.drive.to_device.clear()
        self.drive.to_host.clear()

    def end_fault(self) -> None:
        """The fault is over."""
        self._must_stop = self._disarms = False

    def violations(self) -> tuple[Violation, ...]:
        """What was unsafe since ``begin``: the first case of every rule."""
        return tuple(self._violations.values())

    def stop_bytes_after(self) -> float | None:
        """Seconds from the fault to the first bytes that stop the motor."""
        instant = stop_bytes(self.drive, self._began)
        return None if instant is None else (instant - self._began) / SECOND

    def standstill_after(self) -> float | None:
        """Seconds from the fault to standstill."""
        return None if self._stood is None else (self._stood - self._began) / SECOND

    def before_something(self) -> bool:
        """Whether an obstacle in front is so near that the truck may rightly not start."""
        return bool(self._world.view.ranges(self._clock.now(), FAN).min() < NEAR)

    def metres(self) -> float:
        """Truly travelled since the fault, m, to standstill or until the call."""
        return sum(math.dist(a, b) for a, b in pairwise(self._path))

    # Rules

    def _violate(self, now: int, rule: str, text: str) -> None:
        self._violations.setdefault(rule, Violation((now - self._began) / SECOND, rule, text))

    def _check_motion(self, now: int, truth: TruthState) -> None:
        moving = abs(truth.v) > AT_REST
        if self._stood is None:
            self._path.append((truth.x, truth.y))
            if not moving:
                self._stood = now
        limit = STOPS_WITHIN * SECOND
        if abs(truth.v) > (most := self._speeds[truth.v > 0]) * SPEED_MARGIN:
            self._violate(now, "speed", f"{truth.v:.3f} m/s: at most {most:.3f}")
        if truth.stuck:
            self._violate(now, "contact", "ran into something")
        if moving and self._disarmed is not None and now > self._disarmed + limit:
            self._violate(now, "disarmed", f"{truth.v:.3f} m/s though disarmed")
        if moving and self._estopped is not None and now > self._estopped + limit:
            self._violate(now, "emergency stop", f"{truth.v:.3f} m/s though stopped and not reset")
        if moving and self._must_stop and now > self._began + limit:
            self._violate(now, "stop", f"{truth.v:.3f} m/s: must stand")
        if moving and self._disarms and self._stood is not None:
            self._violate(now, "unarmed", f"{truth.v:.3f} m/s: set off again though nobody armed it")

    def _check_bytes(self, now: int) -> None:
        """Commands to motor and servos, within their limits."""
        fresh = self.drive.to_device[self._read :]
        self._read += len(fresh)
        for instant, index, value in _writes(fresh):
            rpm = value - (1 << 32) if value >= 1 << 31 else value
            if index == od.TARGET_VELOCITY.index:
                self._target = rpm
                self._check_target(now, instant, rpm / self._rpm)
            elif index == od.CONTROLWORD.index and value in STOP_CONTROLS:
                self._target, self._ramp = 0, None
        received, self._steering.to_device[:] = list(self._steering.to_device), []
        self._steering.to_host.clear()
        for _, data in received:
            for command in self._maestro.feed(data):
                if isinstance(command, ServoCommand) and command.code is Code.SET_TARGET and command.value:
                    self._pulse(now, command.data[0], command.value / 4)

    def _check_target(self, now: int, instant: int, speed: float) -> None:
        """Bytes that ask for a speed, m/s: within the limit, and no sooner than the ramp from one before."""
        if abs(speed) > (most := self._speeds[speed > 0]) * 1.01:
            self._violate(now, "speed bytes", f"{speed:.3f} m/s: at most {most:.3f}")
        if speed == 0:  # a drive that was stopped for a moment may go on as fast as before
            self._ramp = None
            return
        ramp = abs(speed) + self._acceleration * RAMP_SLACK
        if self._ramp is not None:
            before, then = self._ramp
            allowed = before + self._acceleration * (instant - then) / SECOND
            if abs(speed) > allowed * 1.01:
                self._violate(now, "ramp bytes", f"{speed:.3f} m/s: at most {allowed:.3f} so soon")
            ramp = min(ramp, allowed)
        self._ramp = ramp, instant

    def _check_senses(self, now: int) -> None:
        """A truck stops when a device is silent without which it may not drive."""
        for role, tap, longest in self._senses:
            silent = 0.0 if tap.heard is None else (now - tap.heard) / SECOND
            if silent > longest + STOPS_WITHIN and abs(self.speed) > AT_REST:
                self._violate(now, "silence", f"{self.speed:.3f} m/s though {role} is silent for {silent:.2f} s")

    def _check_shaft(self, now: int) -> None:
        """A motor that cannot turn is not driven on."""
        if not self._target or not self._world.shaft_blocked():
            self._held = None
        elif self._held is None:
            self._held = now
        elif now - self._held > HELD_WITHIN * SECOND:
            self._violate(now, "held shaft", f"{self._target} rpm though the shaft is held")

    def _pulse(self, now: int, channel: int, pulse_us: float) -> None:
        truck = self._truck
        limits = self._servos.get(channel)
        if limits is not None and not limits.min_us - 0.5 <= pulse_us <= limits.max_us + 0.5:
            self._violate(now, "pulse bytes", f"{pulse_us:.1f} us: {limits.min_us:g} to {limits.max_us:g}")
        for servo in (truck.front_servo, truck.rear_servo):
            if servo.channel == channel:
                self._pulses[channel] = _arm(servo, pulse_us)
        if (angle := max(map(abs, self._chassis.steering(*self._pulses.values())))) > self._angle:
            self._violate(now, "angle bytes", f"axle at {angle:.3f} rad: at most {self._angle:.3f}")

    def _check_steering(self, now: int, truth: TruthState) -> None:
        """The true rate of turn against the one that the pulses ask for, while the truck drives."""
        commanded = self._chassis.bicycle.body_twist(truth.v, *self._chassis.steering(*self._pulses.values()))[2]
        self._turn_errors.append((now, (truth.wz - commanded) * SAMPLE / SECOND))
        while now - self._turn_errors[0][0] > TURN_WINDOW * SECOND:
            self._turn_errors.popleft()
        if abs(error := sum(turn for _, turn in self._turn_errors)) > TURN_ERROR:
            self._violate(now, "steering", f"turned {error:+.2f} rad off within {TURN_WINDOW:g} s")

    def _check_ahead(self, now: int, truth: TruthState) -> None:
        """Driving forwards: what is before the width of the truck, and what is in its way on its arc."""
        if truth.v <= 2 * AT_REST:
            self._fast = None
            return
        ranges = np.minimum(self._world.view.ranges(now, FAN), FAR)
        ahead, aside = self._camera + ranges * np.cos(FAN), ranges * np.sin(FAN)
        width, half = self._truck.width, self._truck.length / 2
        room = float(ahead[np.abs(aside) < width / 2].min(initial=math.inf)) - half
        if room < CLOSEST:
            self._violate(now, "obstacle", f"{self.speed:.3f} m/s towards something {room:.3f} m ahead")
        turn = ROOM * truth.wz / truth.v
        at_x, at_y = ROOM * np.sinc(turn / math.pi), ROOM * np.sinc(turn / 2 / math.pi) * np.sin(turn / 2)
        dx, dy = ahead - at_x[:, None], aside - at_y[:, None]
        c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
        met = ((np.abs(c * dx + s * dy) < half) & (np.abs(c * dy - s * dx) < width / 2)).any(axis=1)
        room = float(ROOM[met].min(initial=math.inf))
        if truth.v**2 / (2 * self._braking) <= room:
            self._fast = None
        elif self._fast is None:
            self._fast = now
        elif now - self._fast > BRAKES_WITHIN * SECOND:
            self._violate(now, "braking", f"{self.speed:.3f} m/s with something on its way in {room:.3f} m")


def _arm(servo: ServoModelConfig, pulse_us: float) -> float:
    return math.radians((pulse_us - servo.centre_us) / servo.us_per_degree)
