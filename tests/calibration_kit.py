"""Calibration against a world that hides the true values: an operator with tape, string and meter, and the judge."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from monstertruck_drivers.ax12.emulator import Ax12Bus, TrueJoints, really
from monstertruck_drivers.emulation import Horn
from monstertruck_drivers.srf08.emulator import SOUND
from monstertruck_kinematics.polynomials import SteeringPolynomials, mirrored
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, run_virtual
from monstertruck_runtime.errors import NoAnswerError
from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.req import DriveRequest, Order
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import Topic, Writer
from monstertruck_sim.world.config import ServoModelConfig, SteadyTilt
from monstertruck_sim.world.noise import IMU_FIXED, generator
from monstertruck_sim.world.plant import PLANT_GRAVITY, TruthState
from monstertruckd.config.calibration import CalibrationStore, Result, Value, WizardName, with_values
from monstertruckd.daemon import Daemon
from monstertruckd.tools.calibrate.steps import Confirm, Number, Plot
from monstertruckd.tools.calibrate.wizard import Wizard, calibrate
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_rigid import CHAIN, HandDriven, rigid_truths

M = TypeVar("M", bound=Message)

STOPPED: Final = 0.2
"""Chance that something stops a servo on its way to one side."""
MODES: Final = {
    "front_left": (1, 0),
    "front_right": (-1, 0),
    "rear_left": (0, 1),
    "rear_right": (0, -1),
    "counter_left": (1, -1),
    "counter_right": (-1, 1),
}
"""Sides to which the front and rear wheels are steered."""
SLIP_NAMES: Final = ("icr_left", "icr_right", "icr_x", "gain_left", "gain_right")
PARKED: Final = (0.2, 1.8, 0.0)
"""Beside a flat wall of the yard, m and rad."""
YARD_WALL: Final = 3.5
"""Its y, m."""
OFF: Final = (0.03, 0.03, 0.1)
"""By which the sonars' places are off at most, m and rad."""
START_UP: Final = 3.0
"""Seconds in which every device of the emulated truck is up."""


class LocalTruck(LocalOperator):
    """What a wizard needs of a client, inside the daemon's process."""

    def __init__(self, daemon: Daemon, clock: Clock, source: str = "calibrate") -> None:
        super().__init__(daemon, clock, source)

    def subscribe(self, topic: Topic[M], delivery: Delivery) -> Mailbox[M]:
        """As a client over Zenoh, which may hear a test stand, too."""
        if topic.writer is not Writer.STAND:
            return super().subscribe(topic, delivery)
        mailbox: Mailbox[M] = Mailbox(delivery, lambda _: tap.close())
        tap = self._daemon.bus.tap(lambda _topic, message, _data, _now: mailbox.put(message), (topic,))  # type: ignore[arg-type]
        return mailbox

    async def drive(self, speed: float, front: float, rear: float = 0.0, lease: float = 0.3) -> None:
        """Inject a drive request as the bridge to Zenoh does."""
        request = {**await self.header(lease), "speed": speed, "front": front, "rear": rear}
        self._daemon.bus.inject(topics.REQ_DRIVE, DriveRequest(**request))


class SilentTruck(LocalTruck):
    """Falls silent when asked to."""

    silent = False

    async def drive(self, speed: float, front: float, rear: float = 0.0, lease: float = 0.3) -> None:
        if not self.silent:
            await super().drive(speed, front, rear, lease)

    async def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> GateState:
        if self.silent:
            raise NoAnswerError("silent")
        return await super().order(order, hold=hold, calibrates=calibrates)


@dataclass(frozen=True, slots=True)
class Hands:
    """How well the operator measures; standard deviations unless it says bounds."""

    tape: float = 0.002
    """One reading of the tape, m"""
    string: float = 0.0035
    """Direction of a string laid along the truck's side, rad"""
    meter_share: float = 0.005
    """Bound of the meter's scale error"""
    meter_volts: float = 0.02
    """Bound of its other errors, V"""


class SimulatedOperator:
    """A ``Panel`` that looks at the world's truth with a tape, a string and a meter.

    Args:
        rig: the truck.
        rng: of the operator's errors.
        hands: how large they are.
        charges: of packs to be put in between two readings of the meter.
    """

    def __init__(
        self,
        rig: VirtualRig,
        rng: np.random.Generator,
        hands: Hands = Hands(),
        charges: tuple[float, ...] = (),
    ) -> None:
        self.said: list[str] = []
        self.seen: Plot | None = None
        self._rig = rig
        self._rng = rng
        self._hands = hands
        self._charges = list(charges)
        self._meter = float(rng.uniform(-hands.meter_share, hands.meter_share))
        self._mark = (0.0, 0.0)
        self._line = 0.0
        self._string = (0.0, 0.0, 0.0)
        self._before = self._truth()

    def say(self, text: str) -> None:
        """Listen."""
        self.said.append(text)

    def progress(self, name: str, done: float, total: float) -> None:
        """Wait."""

    def plot(self, plot: Plot) -> None:
        """Look at it."""
        self.seen = plot

    async def number(self, step: Number) -> float:
        """Measure what is asked for."""
        truth = self._truth()
        match step.name:
            case "distance":
                x, y = self._bumper()
                return math.dist((x, y), self._mark) + self._error(self._hands.tape)
            case "offset":
                x, y, along = self._string
                across = -math.sin(along) * (truth.x - x) + math.cos(along) * (truth.y - y)
                return 100 * (across + self._error(self._hands.tape))
            case "side":
                x, y = self._bumper()
                return math.dist((x, y), self._mark) + self._error(self._hands.tape)
            case "ahead" | "left" | "centre" if self._height(step):
                return 100 * (self._height(step) + self._error(self._hands.tape))
            case "ahead" | "left":
                x, y = self._bumper()
                dx, dy = x - self._mark[0], y - self._mark[1]
                c, s = math.cos(self._line), math.sin(self._line)
                off = c * dx + s * dy if step.name == "ahead" else c * dy - s * dx
                return 100 * (off + self._error(self._hands.tape))
            case "wall":
                side = truth.y + math.cos(truth.yaw) * self._rig.config.sim.world.truck.width / 2
                return YARD_WALL - side + self._error(self._hands.tape)
            case "meter":
                error = float(self._rng.uniform(-1, 1)) * self._hands.meter_volts
                return round(truth.supply_v * (1 + self._meter) + error, 2)
        raise AssertionError(step)

    async def confirm(self, step: Confirm) -> bool:
        """Do or see what is asked for."""
        truth = self._truth()
        match step.name:
            case "mark":
                x, y = self._bumper()
                self._mark = (x + self._error(self._hands.tape), y)
                self._line = truth.yaw + (self._error(self._hands.string) if "string" in step.question else 0.0)
            case "string":
                self._string = (truth.x, truth.y, truth.yaw + self._error(self._hands.string))
            case "level" | "nose" | "side":
                pitch, roll = {"level": (0.0, 0.0), "nose": (9.0, 0.0), "side": (0.0, 11.0)}[step.name]
                tilt = SteadyTilt(kind="steady", pitch_deg=pitch, roll_deg=roll)
                self._rig.world.set_tilt(self._rig.clock.now(), tilt)
            case "forward":
                before = self._before
                along = math.cos(before.yaw) * (truth.x - before.x) + math.sin(before.yaw) * (truth.y - before.y)
                return along > 0
            case "turned":
                return math.remainder(truth.yaw - self._before.yaw, math.tau) > 0
            case "another":
                if self._charges:
                    self._rig.world.set_charge(self._rig.clock.now(), self._charges.pop(0))
                    await self._rig.clock.sleep(2.0)
                    return True
                return False
        self._before = truth
        return True

    def _truth(self) -> TruthState:
        return self._rig.world.truth(self._rig.clock.now())

    def _bumper(self) -> tuple[float, float]:
        """Middle of the front bumper on the floor."""
        truth, ahead = self._truth(), self._rig.config.sim.world.truck.length / 2
        return truth.x + math.cos(truth.yaw) * ahead, truth.y + math.sin(truth.yaw) * ahead

    def _height(self, step: Number) -> float:
        """Of the lidar's beam over the floor, m: at its window, on the wall ahead or to the left; 0 = not asked for."""
        if "beam" not in step.question:
            return 0.0
        lidar, truth = self._rig.config.sim.world.lidar, self._truth()
        if step.name == "centre":
            return lidar.height
        beam = 384 if step.name == "ahead" else 640
        ranges = self._rig.world.lidar.scan(self._rig.clock.now() - SECOND)
        a, b = self._joints()
        pitch, roll = truth.pitch + lidar.pitch + a, truth.roll + lidar.roll + b
        rise = -math.sin(pitch) if step.name == "ahead" else math.sin(roll)
        return lidar.height + float(np.median(ranges[beam - 3 : beam + 4])) / 1000 * rise

    def _joints(self) -> tuple[float, float]:
        """Of the lidar's mount, rad."""
        stabiliser = self._rig.config.devices.stabiliser
        if stabiliser is None:
            return 0.0, 0.0
        bus = self._rig.robot.emulators["stabiliser"]
        assert isinstance(bus, Ax12Bus)
        joints = TrueJoints(bus, stabiliser.driver, self._rig.world.horns())
        pitch, roll = joints.angles(np.array([self._rig.clock.now()]))
        return float(pitch[0]), float(roll[0])

    def _error(self, sigma: float) -> float:
        return sigma * float(self._rng.standard_normal())


def hidden(
    config: SimulatedTruckConfig,
    rng: np.random.Generator,
    seed: int,
    parts: Collection[WizardName] = ("battery", "compass", "drive", "steering"),
) -> SimulatedTruckConfig:
    """``config`` with a truck whose true values differ from what the daemon believes.

    Args:
        config: the believed truck.
        rng: of the differences.
        seed: of the world.
        parts: what differs, by the wizard that has to find it.
    """
    truck: dict[str, Any] = {}
    world: dict[str, Any] = {"truck": truck}
    if "battery" in parts:
        world["battery"] = {"divider": 10 * rng.uniform(0.94, 1.06), "analog_offset": rng.uniform(-0.009, 0.009)}
    if "compass" in parts:
        hard = dict(zip(("hard_x", "hard_y", "hard_z"), rng.uniform(-70, 70, 3).tolist(), strict=True))
        soft = dict(zip(("soft_x", "soft_y", "soft_z"), rng.uniform(0.88, 1.12, 3).tolist(), strict=True))
        world["compass"] = {"iron": {**hard, **soft, "soft_xy": rng.uniform(-0.06, 0.06)}}
    if "drive" in parts:
        truck["wheel_radius"] = 0.075 * rng.uniform(0.95, 1.05)
        truck["motor"] = {"ratio": rng.uniform(500, 680), "inverted": bool(rng.integers(2))}
    if "lidar" in parts:
        own = np.random.default_rng([seed, 11])
        x, y, yaw = own.uniform((0.11, -0.03, -0.05), (0.17, 0.03, 0.05)).tolist()
        pitch, roll = own.uniform(-0.02, 0.02, 2).tolist()
        world["lidar"] = {"x": x, "y": y, "yaw": yaw, "pitch": pitch, "roll": roll}
    if "imu" in parts:
        world["imu"] = {"rate_scale": float(np.random.default_rng([seed, 13]).uniform(0.96, 1.04))}
    if "camera" in parts:
        own = np.random.default_rng([seed, 29])
        names = "x", "y", "height", "yaw", "pitch", "roll", "field_of_view", "k1", "k2"
        low = (0.16, -0.02, 0.23, -0.05, -0.04, -0.04, 1.05, -0.2, -0.01)
        high = (0.2, 0.02, 0.27, 0.05, 0.04, 0.04, 1.15, 0.05, 0.03)
        world["camera"] = dict(zip(names, own.uniform(low, high).tolist(), strict=True))
    if "stabiliser" in parts:
        own = np.random.default_rng([seed, 23])
        world["mount"] = {
            name: {"zero": zero + own.uniform(-8, 8), "direction": int(own.choice((-1, 1)))}
            for name, zero in (("pitch", 511), ("roll", 204))
        }
    if "sonar" in parts:
        own = np.random.default_rng([seed, 19])
        x, y, yaw = PARKED
        world["start"] = {"x": x, "y": y, "yaw": yaw + own.uniform(-0.05, 0.05)}
        places = {
            name: {k: v + own.uniform(-off, off) for k, v, off in zip(("x", "y", "yaw"), place, OFF, strict=True)}
            for name, place in ((n, (s.x, s.y, s.yaw)) for n, s in config.sim.world.sonar.sonars.items())
        }
        world["sonar"] = {"field_of_view": own.uniform(0.8, 0.94), "sonars": places}
    if "odometry" in parts:
        own = np.random.default_rng([seed, 17])
        truck["wheel_radius"] = 0.075 * own.uniform(0.95, 1.05)
        truck["wheelbase"] = 0.32 * own.uniform(0.96, 1.04)
        servos = config.devices.steering.driver if config.devices.steering else None
        assert servos is not None
        off = own.uniform(-1.0, 1.0)
        for name, sign in (("front", 1), ("rear", -1)):
            servo = getattr(config.sim.world.truck, f"{name}_servo")
            centre = getattr(servos, name).centre_us - sign * off * servo.us_per_degree
            truck[f"{name}_servo"] = servo.model_dump() | {"centre_us": centre}
    if "steering" in parts:
        own = np.random.default_rng([seed, 7])
        answer = {"dead_time": own.uniform(0.0, 0.12), "lag": own.uniform(0.0, 0.06)}
        truck["front_servo"], truck["rear_servo"] = _servo(1, rng) | answer, _servo(0, rng) | answer
        truck["steering"] = {axle: _linkage(sign, own) for axle, sign in (("front", 1), ("rear", -1))}
    return with_overlay(config, {"sim": {"seed": seed, "world": world}})


def _linkage(sign: int, rng: np.random.Generator) -> dict[str, Any]:
    """Linkage of an axle whose higher powers are off by up to 100 %."""
    left, right = (
        [*(k * rng.uniform(0.0, 2.0) for k in c[:4]), *c[4:]]
        for c in (SteeringPolynomials().front.left_from_servo, SteeringPolynomials().front.right_from_left)
    )
    pair = (left, right) if sign > 0 else (mirrored(tuple(left)), mirrored(tuple(right)))
    return dict(zip(("left_from_servo", "right_from_left"), pair, strict=True))


def curvature_errors(calibrated: SimulatedTruckConfig) -> dict[str, float]:
    """Greatest error of the curvature that the calibrated truck believes, by mode, as a share.

    From 0.3 of full lock to where pulses reach and nothing stops a servo. True is that of the linkage in the plane, and
    that of the path driven by hand among rigid bodies.
    """
    believed, truck = calibrated.chassis(), calibrated.sim.world.truck
    true, steering = truck.chassis(), calibrated.devices.steering
    assert steering is not None
    assert believed.linkage is not None
    servos = (steering.driver.front, truck.front_servo), (steering.driver.rear, truck.rear_servo)
    ends = [
        [min(max(_arm(ours.quarters(end) / 4, real), -real.right_stop_deg), real.left_stop_deg) for end in reach]
        for (ours, real), reach in zip(servos, believed.linkage.ranges, strict=True)
    ]
    hands = HandDriven(calibrated) if calibrated.sim.world.engine == "mujoco" else None
    errors = {}
    for mode, sides in MODES.items():
        full = [end[side > 0] if side else 0.0 for end, side in zip(ends, sides, strict=True)]
        shares = []
        for share in np.linspace(0.3, 1.0, 8).tolist():
            arms = [share * end for end in full]
            pulses = [real.centre_us + real.us_per_degree * arm for (_, real), arm in zip(servos, arms, strict=True)]
            angles = [ours.angle(round(4 * pulse)) for (ours, _), pulse in zip(servos, pulses, strict=True)]
            servo_angles = np.radians(arms).tolist()
            if hands is None:
                expected = true.bicycle.curvature(*true.steering(*servo_angles))
            else:
                expected = hands.curvature(servo_angles)
            shares.append(believed.bicycle.curvature(*believed.steering(*angles)) / expected - 1)
        errors[mode] = float(np.abs(shares).max())
    return errors


def _arm(pulse_us: float, servo: ServoModelConfig) -> float:
    return (pulse_us - servo.centre_us) / servo.us_per_degree


def _servo(channel: int, rng: np.random.Generator) -> dict[str, Any]:
    def stop() -> float:
        return float(rng.uniform(23, 30)) if rng.random() < STOPPED else 45.0

    return {
        "channel": channel,
        "centre_us": 1439.2 + rng.uniform(-40, 40),
        "us_per_degree": float(rng.choice((-1, 1))) * 10.48 * rng.uniform(0.9, 1.1),
        "left_stop_deg": stop(),
        "right_stop_deg": stop(),
    }


def truths(config: SimulatedTruckConfig) -> dict[WizardName, dict[str, Value]]:
    """True values of what the wizards estimate, by wizard and name, in the plane."""
    world = config.sim.world
    truck, iron = world.truck, world.compass.iron
    rolling = truck.slip_per_newton * truck.rolling_resistance * truck.mass * PLANT_GRAVITY
    turns = truck.motor.ratio / (2 * math.pi * truck.wheel_radius) / (1 - rolling)
    soft = np.linalg.inv(((iron.soft_x, iron.soft_xy), (iron.soft_xy, iron.soft_y)))
    soft /= math.sqrt(np.linalg.det(soft))
    if truck.body.kind == "skid_steer":
        return {"slip": {name: getattr(truck.body, name) for name in SLIP_NAMES}}
    if config.devices.sonar is not None:
        return {"sonar": _sonar_truth(config)}
    steering: dict[str, Value] = {}
    chassis = truck.chassis()
    for axle, (name, servo) in enumerate((("front", truck.front_servo), ("rear", truck.rear_servo))):
        stops = math.radians(servo.left_stop_deg), -math.radians(servo.right_stop_deg)
        left, right = (math.degrees(chassis.steering(*np.roll((stop, 0.0), axle).tolist())[axle]) for stop in stops)
        steering |= {
            f"{name}_centre": servo.centre_us,
            f"{name}_scale": abs(servo.us_per_degree),
            f"{name}_direction": 1 if servo.us_per_degree > 0 else -1,
            f"{name}_left_travel": left,
            f"{name}_right_travel": right,
        }
    servo = truck.front_servo
    steering |= {
        "dead_time": servo.dead_time + CHAIN,
        "lag": servo.lag,
        "delay": servo.dead_time + servo.lag + CHAIN,
    }
    drive = config.devices.drive
    pulses = drive.driver.encoder_pulses_per_turn or 0 if drive is not None else 0
    return {
        "battery": {
            "gain": world.battery.divider / 10,
            "offset": -world.battery.divider * world.battery.analog_offset,
        },
        "compass": {
            "hard_x": 0.1 * iron.hard_x,
            "hard_y": 0.1 * iron.hard_y,
            "soft_xx": float(soft[0, 0]),
            "soft_xy": float(soft[0, 1]),
            "soft_yy": float(soft[1, 1]),
        },
        "drive": {
            "inverted": truck.motor.inverted,
            "drive_ratio": truck.motor.ratio * config.geometry.wheel_radius / truck.wheel_radius,
            "turns_per_metre": turns,
            "start_lag": truck.motor.lag,
            "stop_lag": truck.motor.lag,
            "ticks_per_metre": 4 * pulses * turns,
        },
        "steering": steering,
        "odometry": _odometry_truth(config),
        "lidar": {name: getattr(world.lidar, name) for name in ("x", "y", "yaw", "pitch", "roll")},
        "imu": _imu_truth(config),
        "stabiliser": _stabiliser_truth(config),
        "camera": _camera_truth(config),
    }


def _camera_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    device, camera = config.devices.camera, config.sim.world.camera
    if device is None:
        return {}
    width, height = device.driver.width, device.driver.height
    focal = width / 2 / math.tan(camera.field_of_view / 2)
    found = {name: getattr(camera, name) for name in ("x", "y", "yaw", "pitch", "roll", "k1", "k2")}
    found |= {"focal_x": focal, "focal_y": focal, "centre_x": (width - 1) / 2, "centre_y": (height - 1) / 2}
    return found | {"z": camera.height, "p1": 0.0, "p2": 0.0}


def _stabiliser_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    device, mount = config.devices.stabiliser, config.sim.world.mount
    if device is None:
        return {}
    found: dict[str, Value] = {}
    for name, joint, horn in (("pitch", device.driver.pitch, mount.pitch), ("roll", device.driver.roll, mount.roll)):
        zero, direction = really(joint, Horn(horn.zero, horn.direction))
        found |= {f"{name}_zero": zero, f"{name}_direction": direction}
    return found


def _odometry_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    truck, geometry = config.sim.world.truck, config.geometry
    return {
        "drive_ratio": truck.motor.ratio * geometry.wheel_radius / truck.wheel_radius,
        "wheel_radius": truck.wheel_radius * geometry.drive_ratio / truck.motor.ratio,
        "wheelbase": truck.wheelbase,
        "front_centre": truck.front_servo.centre_us,
        "rear_centre": truck.rear_servo.centre_us,
    }


def _sonar_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    sonar = config.sim.world.sonar
    places = {f"{n}_{what}": getattr(s, what) for n, s in sonar.sonars.items() for what in ("x", "y", "yaw")}
    return {"cone": sonar.field_of_view, "speed_of_sound": SOUND, **places}


def _imu_truth(config: SimulatedTruckConfig) -> dict[str, Value]:
    imu = config.sim.world.imu
    drawn = generator(config.sim.seed, IMU_FIXED).uniform(-1, 1, 6).tolist()
    names = ("rate_x", "rate_y", "rate_z", "force_x", "force_y")
    sizes = (imu.rate_bias,) * 3 + (imu.acceleration_bias,) * 2
    biases = {name: size * part for name, size, part in zip(names, sizes, drawn, strict=False)}
    return {**biases, "rate_scale": 1 / imu.rate_scale}


@dataclass(frozen=True, slots=True)
class Session:
    """One run of a wizard on a simulated truck."""

    result: Result
    file: Path
    seconds: float
    """It took, on the truck's clock."""
    plot: Plot | None
    """The last one shown."""


def run_session(
    config: SimulatedTruckConfig,
    wizard: Wizard,
    rng: np.random.Generator,
    *,
    hands: Hands = Hands(),
    charges: tuple[float, ...] = (),
) -> Session:
    """Start the truck with the calibration in its state directory, run one wizard, end it, on a virtual clock.

    Raises:
        TruckError: whatever ended the wizard.
    """
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    known = current.results if current is not None else {}
    calibrated = with_values(config, known.values(), "calibration")

    async def main(clock: VirtualClock) -> Session:
        rig = VirtualRig(calibrated, clock)
        async with rig.running():
            await clock.sleep(START_UP)
            operator = SimulatedOperator(rig, rng, hands, charges)
            began = clock.now()
            truck = LocalTruck(rig.daemon, clock)
            result, file = await calibrate(wizard, truck, operator, clock, calibrated, known)
            return Session(result, Path(file), (clock.now() - began) / SECOND, operator.seen)

    return run_virtual(main)


@dataclass(frozen=True, slots=True)
class Verdict:
    """One estimate and its truth."""

    name: str
    """wizard.estimate"""
    value: Value
    low: float | None
    high: float | None
    truth: Value

    @property
    def holds(self) -> bool:
        """Whether the truth lies in the stated interval; what has none must be right."""
        if self.low is None or self.high is None:
            return self.value == self.truth
        return self.low <= self.truth <= self.high


def distance_from_fit(plot: Plot) -> float:
    """Median distance of the measurements from the fit, as a fraction of the ranges on both axes; 0 without a fit.

    A range less than 5 % of its values counts as 5 % of them: a twentieth of it is a tape's error, 5 mm of 2 m.
    """
    assert len(plot.points)
    assert np.isfinite(plot.points).all()
    if plot.curve is None:
        return 0.0
    everything = np.vstack((plot.points, plot.curve))
    low, span = everything.min(axis=0), np.maximum(np.ptp(everything, axis=0), 0.05 * np.abs(everything).max(axis=0))
    points, curve = (plot.points - low) / span, (plot.curve - low) / span
    along = np.linspace(0, len(curve) - 1, 1000)
    dense = np.column_stack([np.interp(along, np.arange(len(curve)), axis) for axis in curve.T])
    return float(np.median(np.hypot(*(points[:, None] - dense).T).min(axis=0)))


def verdicts(result: Result, config: SimulatedTruckConfig) -> list[Verdict]:
    """Every estimate of ``result`` whose truth is known; travel counts where something stopped the wheels."""
    known = truths(config)[result.wizard]
    if config.sim.world.engine == "mujoco":
        known |= rigid_truths(result.wizard, config)
    return [
        Verdict(f"{result.wizard}.{e.name}", e.value, e.low, e.high, known[e.name])
        for e in result.estimates
        if e.name in known and not (e.name.endswith("_travel") and e.low is None)
    ]
