"""True values of a robot of rigid bodies: how it moves on a level floor, driven by hand, without noise or daemon.

In the plane radius, ratio, servos, wheelbase and turning centres are the truth themselves. Rigid bodies have loaded
tyres that give way and slip: what a wizard has to find there is how the robot really moves, which is measured here by
the world's own truth. Signs, centres and scales of servos are the same in both.
"""

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.polynomials import SERVO_LIMIT
from monstertruck_kinematics.se2 import to_body
from monstertruck_kinematics.truck import LinkedAxles
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.map_files import FREE, WorldMap
from monstertruck_sim.robot import carries_lidar
from monstertruck_sim.world.built_in import BuiltIn
from monstertruck_sim.world.plant import TruthState
from monstertruck_sim.world.scene import Surroundings
from monstertruck_sim.world.world import World
from monstertruckd.config.calibration import Value, WizardName
from monstertruckd.tools.calibrate import odometry, slip, weave
from monstertruckd.tools.calibrate.response import ResponseFit, Steps
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

BASE = 0.3

SPEED = 0.15

WEAVE = (0.3, 0.3, 0.3, 0.3, 1.2)

PERIOD: Final = 0.02
"""Step in which the world is advanced and read, s: the period of the servos' pulses."""
ACCELERATION: Final = 20_000.0
"""Acceleration of the motors, rpm/s."""
SETTLED: Final = 1.0
"""Seconds after which a motion is steady."""
SPEED: Final = 0.15
"""Speed straight ahead and in circles, m/s."""
ROUNDS: Final = 5
"""Repetitions of ``weave.WEAVE``: the wizard's 1.8 m."""
CHAIN: Final = 0.012
"""Delay from a command of the gate to the servo, s: the serial line, and half a frame of pulses."""


class Motion(NamedTuple):
    """A steady motion between two instants."""

    turns: Array
    """Of the wheels, by the shaft of each motor, rad; (n,)."""
    ahead: float
    """In the robot's first own frame, m."""
    left: float
    turn: float
    """Rad."""

    @property
    def length(self) -> float:
        """Length of the arc, m."""
        half = self.turn / 2
        return math.hypot(self.ahead, self.left) * (half / math.sin(half) if half else 1.0)

    @property
    def twist(self) -> tuple[float, float]:
        """Constant velocities ahead and to the left that make it, times its duration, m."""
        half = self.turn / 2
        share = half / math.tan(half) if half else 1.0
        return share * self.ahead + half * self.left, share * self.left - half * self.ahead


class HandDriven:
    """A robot at the origin of an open level floor that is given speeds and angles directly.

    Args:
        config: of the robot; map, people, pictures and noise of its world are left out.
    """

    def __init__(self, config: SimulatedTruckConfig) -> None:
        self._truck = config.sim.world.truck
        floor = BuiltIn(WorldMap(np.full((400, 400), FREE, np.int8), 0.05, (-10.0, -10.0)), (0.0, 0.0, 0.0))
        camera = config.sim.world.camera.model_copy(update={"rendered": False})
        bare = {"noise": False, "start": None, "people": (), "tags": (), "board": None, "camera": camera}
        scene = Surroundings(floor, (), 0, [floor.start])
        world = config.sim.world.model_copy(update=bare)
        self._world = World(world, 0, scene, lidar=carries_lidar(config.devices))
        self.now = SECOND
        """Time of its world, ns."""
        self._pulses = {servo.channel: servo.centre_us for servo in self._truck.servos}
        self._world.truth(self.now)
        self._world.servos.attach(self)

    def pulse_us(self, channel: int, _time_ns: int) -> float | None:
        """As ``PulseSource``."""
        return self._pulses.get(channel)

    def steer(self, servos: Sequence[float]) -> None:
        """Angles of the servos' arms, rad."""
        for servo, angle in zip(self._truck.servos, servos, strict=True):
            self._pulses[servo.channel] = servo.centre_us + servo.us_per_degree * math.degrees(angle)

    def drive(self, *speeds: float) -> None:
        """Of every shaft's wheels along the ground, if they had their radius and did not slip, m/s."""
        motor = self._truck.motor
        sign, rpm = -1 if motor.inverted else 1, motor.ratio * 60 / math.tau / self._truck.wheel_radius
        for source, speed in zip(self._world.motors, speeds, strict=True):
            source.command(self.now, sign * speed * rpm, ACCELERATION)

    def wait(self, seconds: float) -> list[TruthState]:
        """What is the case at the end of every period, up to then."""
        found = []
        for _ in range(round(seconds / PERIOD)):
            self.now += round(PERIOD * SECOND)
            found.append(self._world.truth(self.now))
        return found

    def moved(self, *speeds: float, seconds: float) -> Motion:
        """Once it moves steadily; speeds as of ``drive``."""
        self.drive(*speeds)
        first = self.wait(SETTLED)[-1]
        before = self._turns()
        states = [first, *self.wait(seconds)]
        yaws = np.unwrap([state.yaw for state in states])
        ahead, left = to_body(first.yaw, states[-1].x - first.x, states[-1].y - first.y)
        return Motion(self._turns() - before, float(ahead), float(left), float(yaws[-1] - yaws[0]))

    def curvature(self, servos: Sequence[float]) -> float:
        """Of the path of its middle at angles of the servos, 1/m, left positive."""
        self.steer(servos)
        motion = self.moved(SPEED, seconds=1.0)
        return motion.turn / motion.length

    def _turns(self) -> Array:
        motor = self._truck.motor
        per_turn = math.tau / motor.ratio * (-1 if motor.inverted else 1)
        return np.array([source.reading(self.now).turns * per_turn for source in self._world.motors])


def rigid_truths(wizard: WizardName, config: SimulatedTruckConfig) -> dict[str, Value]:
    """What a wizard has to find where it is not what the plane is made of, by name."""
    measure = _MEASURES.get(wizard)
    return {} if measure is None else measure(config)


def drive_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    """Turns of the motor on a metre straight ahead, and what follows from them."""
    drive, geometry = config.devices.drive, config.geometry
    motion = HandDriven(config).moved(SPEED, seconds=2.0)
    turns = float(motion.turns[0]) / math.tau * config.sim.world.truck.motor.ratio / motion.length
    pulses = 0 if drive is None else drive.driver.encoder_pulses_per_turn or 0
    ratio = turns * math.tau * geometry.wheel_radius
    return {"turns_per_metre": turns, "drive_ratio": ratio, "ticks_per_metre": 4 * pulses * turns}


def steering_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    """Delay of the turns behind the gate's commands, and the axles' angles where something stops the servos.

    The angles change as fast as the gate lets them. Tyres and body swing into a turn: given are the dead time and the
    lag of first order that come nearest to the true turns of the wizard's weaves, by its own measure, turns in 0.3 s.
    """
    chassis, step = config.sim.world.truck.chassis(), config.gate.steering_rate * PERIOD
    assert isinstance(chassis, TruckChassis)
    assert isinstance(chassis.linkage, LinkedAxles)
    changes = np.cumsum([0.0, *WEAVE * ROUNDS])
    seen = []
    for way in (1, -1):
        hands, angle, sent, states = HandDriven(config), 0.0, [], []
        hands.drive(way * SPEED)
        hands.wait(SETTLED)
        for start in np.arange(0.0, changes[-1], PERIOD):
            side = 1 if np.searchsorted(changes, start + PERIOD / 2) % 2 else -1
            angle += min(max(side * weave.ANGLE - angle, -step), step)
            hands.steer(chassis.linkage.servos(angle, -angle))
            sent.append((hands.now / SECOND, chassis.bicycle.body_twist(1.0, angle, -angle)[2]))
            states += hands.wait(PERIOD)
        times, x, y = np.array([(state.time_ns / SECOND, state.x, state.y) for state in states]).T
        yaws, stride = np.unwrap([state.yaw for state in states]), round(BASE / PERIOD)
        ways = way * np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y))))
        seen.append(weave.Weave(Steps.of(*np.array(sent).T), times, ways, stride, yaws[stride:] - yaws[:-stride]))

    def residuals(delay: float, squared: float) -> Array:
        return np.concatenate([each.residuals(delay, squared) for each in seen])

    found = ResponseFit.of(residuals, 0.0)
    delay, lag = found.delay.value + CHAIN, math.sqrt(max(found.squared.value, 0.0))
    return {"dead_time": delay - lag, "lag": lag, "delay": delay, **_travels(config, chassis)}


def _travels(config: SimulatedTruckConfig, chassis: TruckChassis) -> dict[str, Value]:
    """Angles of one axle, deg, that mean the curvature of the path with its servo at a stop, the other one straight."""
    truck, bicycle, hands = config.sim.world.truck, chassis.bicycle, HandDriven(config)
    found: dict[str, Value] = {}
    for axle, (name, servo) in enumerate((("front", truck.front_servo), ("rear", truck.rear_servo))):
        for side, stop in (("left", servo.left_stop_deg), ("right", -servo.right_stop_deg)):
            if math.radians(abs(stop)) < SERVO_LIMIT:
                curvature = hands.curvature(np.roll((math.radians(stop), 0.0), axle).tolist())
                # The middle of the turn lies on the axle that is straight.
                sideslip = math.asin(curvature * (bicycle.l_r if axle == 0 else -bicycle.l_f))
                found[f"{name}_{side}_travel"] = math.degrees(bicycle.steer_for(curvature, sideslip)[axle])
    return found


def odometry_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    """Distance scale, and the wheelbase by which the linkage turns as the truck in the wizard's corners."""
    truck, geometry = config.sim.world.truck, config.geometry
    chassis, straight, hands = truck.chassis(), drive_truth(config), HandDriven(config)
    assert isinstance(chassis, TruckChassis)
    assert isinstance(chassis.linkage, LinkedAxles)
    ratio = float(straight["drive_ratio"])
    rolling = geometry.wheel_radius / ratio * truck.motor.ratio
    bases = []
    for side in (1, -1):
        servos = chassis.linkage.servos(side * odometry.ANGLE, -side * odometry.ANGLE)
        hands.steer(servos)
        motion, axles = hands.moved(odometry.CORNER, seconds=4.0), chassis.steering(*servos)
        way = float(motion.turns[0]) * rolling / chassis.bicycle.drive_speed(1.0, *axles)
        bases.append(truck.wheelbase * way * chassis.bicycle.curvature(*axles) / motion.turn)
    radius = geometry.wheel_radius * geometry.drive_ratio / ratio
    return {"drive_ratio": ratio, "wheel_radius": radius, "wheelbase": float(np.mean(bases))}


def slip_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    """Turning centres and gains of a skid-steer body: v_x - w y = gain r rate of each side, v_y + w x = 0.

    Least squares over the wizard's arcs.
    """
    geometry, speed, hands = config.geometry, 0.6 * config.gate.speed, HandDriven(config)
    arcs = []
    for share in slip.RADII:
        for side in (1, -1) if share else (0,):
            lean = side / (2 * share) if share else 0.0
            for way in (speed, -speed):
                left, right = way * (1 - lean), way * (1 + lean)
                motion = hands.moved(*(left, right) * (len(config.sim.world.truck.chassis().shafts) // 2), seconds=4.0)
                arcs.append((*(motion.turns[i::2].mean() for i in (0, 1)), *motion.twist, motion.turn))
    *rates, ahead, aside, turn = np.array(arcs).T
    found: dict[str, Value] = {"icr_x": float(-(aside @ turn) / (turn @ turn))}
    for name, rate in zip(("left", "right"), rates, strict=True):
        basis = np.column_stack((geometry.wheel_radius * rate, turn))
        found[f"gain_{name}"], found[f"icr_{name}"] = np.linalg.lstsq(basis, ahead, rcond=None)[0].tolist()
    return found


_MEASURES: Final[dict[WizardName, Callable[[SimulatedTruckConfig], dict[str, Value]]]] = {
    "drive": drive_truth,
    "steering": steering_truth,
    "odometry": odometry_truth,
    "slip": slip_truth,
}
