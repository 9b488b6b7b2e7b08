"""The judge of a drill: sees bytes on two wires, the world's truth, the operator's orders; nothing of the daemon."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.maestro.protocol import Code, Command, Decoder
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import DriveTrain, FourWheelSteering
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_sim.world.config import ServoConfig
from monstertruck_sim.world.truck_plant import TruthState
from monstertruck_sim.world.world import World
from monstertruckd.tools.drill.scenario import AT_REST
from monstertruckd.tools.drill.wire import WireTap, stop_bytes, written
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

SAMPLE: Final = SECOND // 100
STOPS_WITHIN: Final = 0.6
"""Seconds from any fault that must stop the truck, or from a disarm order, to standstill."""
CLOSEST: Final = 0.03
"""Nothing nearer than this, m, may be driven towards."""
NEAR: Final = 0.6
"""Metres from the camera within which things are near."""
SPEED_MARGIN: Final = 1.05
"""True speed over the greatest commanded one: the motor's overshoot."""
ANGLE_MARGIN: Final = 0.01
"""Rounding of pulses, rad."""
STRAYED: Final = 0.5
"""Greatest difference of the true turn from the one the pulses ask for within ``STRAY_WINDOW`` s, rad."""
STRAY_WINDOW: Final = 2.0
FAN: Final = np.linspace(-1.2, 1.2, 49)


@dataclass(frozen=True, slots=True)
class Violation:
    """Something unsafe."""

    seconds: float
    """Since the fault."""
    rule: str
    text: str


class Observer:
    """Watches one truck; ``begin`` and ``end_fault`` bound one fault.

    Args:
        config: of the truck, for its limits.
        world: what is true.
        ports: whose wires are tapped: drive and steering.
        clock: time.
    """

    def __init__(
        self, config: SimulatedTruckConfig, world: World, ports: Mapping[str, MemoryPort], clock: Clock
    ) -> None:
        assert config.devices.steering is not None
        self._world = world
        self._clock = clock
        self._drive = WireTap(ports["drive"], clock)
        self._steering = WireTap(ports["steering"], clock)
        self._maestro = Decoder(crc=config.devices.steering.driver.use_crc)
        self._truck = truck = config.sim.world.truck
        self._linkage = SteeringPolynomials.named(truck.steering)
        self._kinematics = FourWheelSteering(truck.wheelbase, truck.track)
        self._angle = config.gate.angle + ANGLE_MARGIN
        self._speed = config.gate.speed
        self._camera = config.sim.world.camera.x
        drivetrain = DriveTrain(truck.motor.ratio, truck.wheel_radius)
        self._rpm = drivetrain.motor_rate(config.gate.speed) * 30 / math.pi
        self._pulses = {truck.front_servo.channel: 0.0, truck.rear_servo.channel: 0.0}
        """Axle angles that the newest pulses ask for, rad."""
        self._strayed: deque[tuple[int, float]] = deque()
        self._disarmed: int | None = None
        self._began = 0
        self._heard = 0
        self._must_stop = False
        self._stood: int | None = None
        self._path: list[tuple[float, float]] = []
        self._violations: dict[str, Violation] = {}
        self.speed = 0.0
        """True speed, m/s."""

    async def run(self) -> None:
        """Look a hundred times a second until cancelled."""
        due = self._clock.now()
        turn = 0
        while True:
            now = self._clock.now()
            truth = self._world.truth(now)
            self.speed = truth.v
            self._look(now, truth)
            self._listen(now)
            self._compare(now, truth)
            if turn % 5 == 0 and truth.v > 2 * AT_REST:
                self._look_ahead(now)
            turn += 1
            due += SAMPLE
            await self._clock.sleep_until(due)

    # What the drill tells

    def disarm(self) -> None:
        """The operator disarms: soon nothing may move."""
        self._disarmed = self._clock.now()

    def arm(self) -> None:
        """The operator arms: from now on the truck may move."""
        self._disarmed = None

    def begin(self, *, stops: bool) -> None:
        """A fault happens now; with ``stops`` the truck must stand soon."""
        self._began = self._clock.now()
        self._must_stop = stops
        self._stood = None
        self._path.clear()
        self._strayed.clear()
        self._violations.clear()
        self._drive.to_device.clear()
        self._drive.to_host.clear()

    def end_fault(self) -> None:
        """The fault is over."""
        self._must_stop = False

    def violations(self) -> tuple[Violation, ...]:
        """What was unsafe since ``begin``: the first case of every rule."""
        return tuple(self._violations.values())

    def stop_bytes_after(self) -> float | None:
        """Seconds from the fault to the first bytes that stop the motor."""
        instant = stop_bytes(self._drive, self._began)
        return None if instant is None else (instant - self._began) / SECOND

    def standstill_after(self) -> float | None:
        """Seconds from the fault to standstill."""
        return None if self._stood is None else (self._stood - self._began) / SECOND

    def before_something(self) -> bool:
        """Whether anything in front is so near that a truck may be right not to set off."""
        return bool(self._world.view.ranges(self._clock.now(), FAN).min() < NEAR)

    def metres(self) -> float:
        """Truly travelled since the fault, to standstill or until now."""
        return sum(math.dist(a, b) for a, b in zip(self._path, self._path[1:], strict=False))

    # Rules

    def _violate(self, now: int, rule: str, text: str) -> None:
        self._violations.setdefault(rule, Violation((now - self._began) / SECOND, rule, text))

    def _look(self, now: int, truth: TruthState) -> None:
        moving = abs(truth.v) > AT_REST
        if self._stood is None:
            self._path.append((truth.x, truth.y))
            if not moving:
                self._stood = now
        limit = STOPS_WITHIN * SECOND
        if abs(truth.v) > self._speed * SPEED_MARGIN:
            self._violate(now, "speed", f"{truth.v:.3f} m/s: at most {self._speed:.3f}")
        if truth.stuck:
            self._violate(now, "contact", "ran into something")
        if moving and self._disarmed is not None and now > self._disarmed + limit:
            self._violate(now, "disarmed", f"{truth.v:.3f} m/s though disarmed")
        if moving and self._must_stop and now > self._began + limit:
            self._violate(now, "stop", f"{truth.v:.3f} m/s: must stand")

    def _listen(self, now: int) -> None:
        """What the bytes ask of motor and servos."""
        since, self._heard = self._heard, now + 1
        for _, index, value in written(self._drive, since):
            rpm = value - (1 << 32) if value >= 1 << 31 else value
            if index == od.TARGET_VELOCITY.index and abs(rpm) > self._rpm * 1.01:
                self._violate(now, "speed bytes", f"{rpm} rpm: at most {self._rpm:.0f}")
        heard, self._steering.to_device[:] = list(self._steering.to_device), []
        self._steering.to_host.clear()
        for _, data in heard:
            for command in self._maestro.feed(data):
                if isinstance(command, Command) and command.code is Code.SET_TARGET and command.value:
                    self._pulse(now, command.data[0], command.value / 4)

    def _pulse(self, now: int, channel: int, pulse_us: float) -> None:
        truck, linkage = self._truck, self._linkage
        for servo, axle in ((truck.front_servo, linkage.front), (truck.rear_servo, linkage.rear)):
            if servo.channel == channel:
                arm = min(max(_arm(servo, pulse_us), -axle.servo_limit), axle.servo_limit)
                angle = axle.axle_from_servo(arm)
                self._pulses[channel] = angle
                if abs(angle) > self._angle:
                    self._violate(now, "angle bytes", f"axle at {angle:.3f} rad: at most {self._angle:.3f}")

    def _compare(self, now: int, truth: TruthState) -> None:
        """The steering's truth against its bytes, while the truck drives."""
        wanted = self._kinematics.body_twist(truth.v, *self._pulses.values())[2]
        self._strayed.append((now, (truth.wz - wanted) * SAMPLE / SECOND))
        while now - self._strayed[0][0] > STRAY_WINDOW * SECOND:
            self._strayed.popleft()
        if abs(strayed := sum(row[1] for row in self._strayed)) > STRAYED:
            self._violate(now, "steering", f"turned {strayed:+.2f} rad off within {STRAY_WINDOW:g} s")

    def _look_ahead(self, now: int) -> None:
        """Driving forwards: how near is what stands before the whole width of the truck?"""
        ranges = self._world.view.ranges(now, FAN)
        ahead, beside = ranges * np.cos(FAN), ranges * np.sin(FAN)
        before = ahead[np.abs(beside) < self._truck.width / 2]
        room = float(before.min(initial=math.inf)) + self._camera - self._truck.length / 2
        if room < CLOSEST:
            self._violate(now, "obstacle", f"{self.speed:.3f} m/s towards something {room:.3f} m ahead")


def _arm(servo: ServoConfig, pulse_us: float) -> float:
    return math.radians((pulse_us - servo.centre_us) / servo.us_per_degree)
