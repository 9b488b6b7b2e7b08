"""A truck around the gate: fresh sensors on request and a motor that obeys."""

import math
from typing import NamedTuple

import numpy as np

from monstertruck_kinematics.chassis import (
    Dimensions,
    ackermann_chassis,
    differential_chassis,
    independent_chassis,
    mecanum_chassis,
    omni_chassis,
    skid_steer_chassis,
    synchro_chassis,
    truck_chassis,
)
from monstertruck_kinematics.truck import DriveTrain, FourWheelSteering
from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.base import servo_fields
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Event
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest, Order, RequestedTwist, Role
from monstertruck_schemas.sensor import (
    Attitude,
    Battery,
    BatteryLevel,
    DriveFeedback,
    DriveMode,
    LaserScan,
    SonarRanges,
    SteeringFeedback,
)
from monstertruck_schemas.state import GateMode, Odometry, Peers
from monstertruckd.gate.arbitration import GateStateMachine
from monstertruckd.gate.checks import Checks, GateView, Tick
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.core import Gate, sensor_checks
from monstertruckd.gate.motion import Motion
from monstertruckd.gate.samples import Samples

TICK = SECOND // 50
NONCE = "run-1"
SENSORS = ("scan", "attitude", "drive", "steering", "battery")
DRIVETRAIN = DriveTrain()
STEERING = FourWheelSteering()
SERVICES = {
    "lidar": Reason.SCAN_STALE,
    "compass": Reason.ATTITUDE_STALE,
    "drive": Reason.DRIVE_STALE,
    "drive_2": Reason.DRIVE_STALE,
    "steering": Reason.STEERING_STALE,
}
CHASSIS = truck_chassis(Dimensions(DRIVETRAIN))
ANY_GROUND = {"unseen_speed": 1.0, "unseen": "slow"}
"""Settings for obstacles that take ground no scan has seen for seen."""


def make_gate(
    latched=False,
    nonce=NONCE,
    chassis=CHASSIS,
    services=SERVICES,
    battery_measured=False,
    rear_sonars=None,
    peers=None,
    zones=None,
    docks=None,
    own=None,
    **config,
):
    return Gate(
        GateConfig(**config),
        chassis=chassis,
        footprint=Footprint(),
        points=[ScanPoints((0.14, 0.0, 0.0))],
        services=services,
        nonce=nonce,
        battery_measured=battery_measured,
        latched=latched,
        rear_sonars=rear_sonars,
        peers=peers,
        zones=zones,
        docks=docks or {},
        own=own or {},
    )


SHOWN = {
    LaserScan: topics.SCAN,
    Attitude: topics.COMPASS,
    SteeringFeedback: topics.STEERING,
    Battery: topics.BATTERY,
    SonarRanges: topics.SONAR,
    Peers: topics.PEERS,
    Odometry: topics.POSE,
    HealthTable: topics.HEALTH,
    Event: topics.EVENT,
}


def show(gate, message, shaft=0):
    """Show a gate a message under its topic."""
    gate.observe(message, topics.DRIVES[shaft] if isinstance(message, DriveFeedback) else SHOWN[type(message)])


class Assessment(NamedTuple):
    """What samples and their checks say at one time."""

    blocks: tuple
    limits: dict
    values: dict


class Monitor:
    """The newest samples and the checks of sensors, without the rest of the gate."""

    def __init__(self, chassis=CHASSIS, *, battery_measured=True, services=SERVICES, **config):
        limits = InForce(GateConfig(**config))
        self.samples = Samples(limits, chassis, services)
        view = GateView(
            limits, chassis, Footprint(), self.samples, Motion(limits, chassis), GateStateMachine(None, latched=False)
        )
        self._checks = Checks(sensor_checks(view, battery_measured=battery_measured))

    def __getattr__(self, name):
        return getattr(self.samples, name)

    def observe(self, message, topic):
        self.samples.observe(message, topic)
        self._checks.observe(message, topic)

    def tick(self, now):
        self._checks.observe(Tick(now, TICK), None)

    def assess(self, now):
        return Assessment(self._checks.blocks(now), self._checks.limits(now, None), self.samples.values(now))


def check_of(gate, kind):
    """The gate's check of a class."""
    return next(check for check in gate._checks if isinstance(check, kind))


def header(now, seq=0, **more):
    return {"stamp": now, "received": now, "seq": seq, **more}


def scan(now, *obstacles, unknown=(), **more):
    """A scan of the plane around a lidar at (0.14, 0), with every beam that meets one of the points given in base.

    The first beam meets a wall far off. ``unknown``: (from, to, code) in degrees, left positive, give a code.
    """
    ranges = np.full(682, math.inf)
    codes = np.zeros(682, dtype=np.uint8)
    step = math.radians(240) / 681
    ranges[0], codes[0] = 3.9, 255
    for x, y in obstacles:
        beam = round((math.atan2(y, x - 0.14) + math.radians(120)) / step)
        ranges[beam], codes[beam] = min(ranges[beam], math.hypot(x - 0.14, y)), 255
    for begin, end, code in unknown:
        first, last = (round(math.radians(degrees + 120) / step) for degrees in (begin, end))
        ranges[first : last + 1], codes[first : last + 1] = math.inf, code
    return LaserScan(
        **header(now),
        frame="lidar",
        start_angle=-math.radians(120),
        end_angle=math.radians(120),
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.06,
        range_max=4.0,
        ranges=ranges,
        codes=codes,
        **more,
    )


def attitude(now, roll=0.0, pitch=0.0, tilt_valid=True):
    return Attitude(**header(now), heading=0.0, roll=roll, pitch=pitch, tilt_valid=tilt_valid)


def feedback(now, speed=0.0, mode=DriveMode.ENABLED, fault_code=None, current=None, position=0.0):
    """Feedback at a speed (m/s) and a travelled distance (m)."""
    rate, angle = DRIVETRAIN.motor_rate(speed), DRIVETRAIN.motor_angle(position)
    return DriveFeedback(
        **header(now), position=angle, velocity=rate, mode=mode, fault_code=fault_code, current=current
    )


def servos(now, front=0.0, rear=0.0, trusted=True):
    return SteeringFeedback(**header(now), front=front, rear=rear, trusted=trusted)


def battery(now, level=BatteryLevel.NORMAL, voltage=23.0):
    return Battery(**header(now), voltage=voltage, raw_voltage=23.0, cells=6, level=level)


def health(now, state=ServiceState.READY, name="planner", **more):
    return HealthTable(**header(now), services=(ServiceHealth(name=name, state=state, since=now, **more),))


class Rig:
    """A gate, the time, and a truck whose speed follows the commands as the drive controller's profile does."""

    def __init__(self, latched=False, chassis=CHASSIS, battery_measured=False, rear_sonars=None, **config):
        self.gate = make_gate(
            latched, chassis=chassis, battery_measured=battery_measured, rear_sonars=rear_sonars, **config
        )
        self.config = GateConfig(**config)
        self.now = SECOND
        self.speed = 0.0
        self.silent = set()
        self.obstacles = ()
        self.unknown = ()
        self.tilt = 0.0
        self.tilt_valid = True
        self.level = BatteryLevel.NORMAL
        self.fault = False
        self.out = None
        self.events = []
        self.trips = []
        self.travelled = 0.0
        self.mode, self.current = DriveMode.ENABLED, None
        """Power state of the drive, and the current that it measures, A."""
        self.shown = 1.0
        """Share of its speed that the drive reports."""
        self.driver = None
        self._seq = 0

    def seq(self):
        self._seq += 1
        return self._seq

    def drive(self, speed=0.2, front=0.0, rear=0.0, source="ann", role=Role.GAMEPAD, lease=1.0, inside=False, **more):
        fields = {**header(self.now, self.seq()), "nonce": NONCE, "gate_stamp": self.now, **more}
        request = DriveRequest(source=source, role=role, lease=lease, speed=speed, front=front, rear=rear, **fields)
        return self._ask(request, inside=inside)

    def twist(self, vx=0.0, vy=0.0, wz=0.0, source="ann", role=Role.GAMEPAD, lease=1.0, inside=False, **more):
        fields = {**header(self.now, self.seq()), "nonce": NONCE, "gate_stamp": self.now, **more}
        twist = RequestedTwist(vx=vx, vy=vy, wz=wz)
        request = DriveRequest(source=source, role=role, lease=lease, speed=0.0, front=0.0, twist=twist, **fields)
        return self._ask(request, inside=inside)

    def roll(self, *rates, source="ann", role=Role.GAMEPAD, lease=1.0, inside=False, **more):
        """Ask for shaft speeds, rad/s."""
        fields = {**header(self.now, self.seq()), "nonce": NONCE, "gate_stamp": self.now, **more}
        request = DriveRequest(source=source, role=role, lease=lease, speed=0.0, front=0.0, shafts=rates, **fields)
        return self._ask(request, inside=inside)

    def _ask(self, request, inside):
        return (self.gate.planner_request if inside else self.gate.request)(request, self.now)

    def order(self, order, source="ann", role=Role.GAMEPAD, **more):
        return self.decide(order, source, role, **more).reason

    def decide(self, order, source="ann", role=Role.GAMEPAD, **more):
        fields = {**header(self.now, self.seq()), "nonce": NONCE, "gate_stamp": self.now, **more}
        request = ControlRequest(source=source, role=role, lease=1.0, order=order, **fields)
        return self.gate.control(request, self.now)

    def sense(self):
        """Every sensor that is not silent delivers now."""
        mode = DriveMode.FAULT if self.fault else self.mode
        samples = {
            "scan": lambda: show(self.gate, scan(self.now, *self.obstacles, unknown=self.unknown)),
            "attitude": lambda: show(self.gate, attitude(self.now, roll=self.tilt, tilt_valid=self.tilt_valid)),
            "drive": lambda: show(self.gate, feedback(self.now, self.shown * self.speed, mode, current=self.current)),
            "steering": lambda: show(self.gate, servos(self.now)),
            "battery": lambda: show(self.gate, battery(self.now, self.level)),
        }
        for name, send in samples.items():
            if name not in self.silent:
                send()

    def tick(self, count=1, sense=True):
        """Advance by whole ticks; ``self.driver`` (keywords of ``drive``) asks at each of them."""
        for _ in range(count):
            self.now += TICK
            if sense:
                self.sense()
            if isinstance(self.driver, tuple):
                self.roll(*self.driver)
            elif self.driver is not None:
                (self.twist if self.driver.keys() & {"vx", "vy", "wz"} else self.drive)(**self.driver)
            self.out = self.gate.tick(self.now)
            self.events += self.out.events
            self.trips += self.out.trips
            self._obey()
        return self.out

    def _obey(self):
        quick = self.out.action is DriveAction.QUICK_STOP
        target = self.out.speeds[0] if self.out.action is DriveAction.RUN else 0.0
        step = (self.config.quick_deceleration if quick else self.config.deceleration) * 0.02
        self.speed += min(max(target - self.speed, -step), step)
        self.travelled += abs(self.speed) * 0.02

    def armed(self, **more):
        self.tick(2)
        assert self.order(Order.ARM, **more) == "ok"
        self.tick()
        assert self.out.mode is GateMode.ARMED
        return self

    def driving(self, ticks=40, **driver):
        """Armed and driven by ``driver`` until at speed."""
        self.armed()
        self.driver = driver
        self.tick(ticks)
        assert self.out.mode is GateMode.DRIVING
        return self

    def reported(self, reason):
        return [event for event in self.events if event.reason is reason]


SIZE = Dimensions(DRIVETRAIN)
BODIES = {
    "truck": truck_chassis(SIZE),
    "ackermann": ackermann_chassis(SIZE),
    "differential": differential_chassis(SIZE),
    "skid_steer": skid_steer_chassis(SIZE, icr_left=0.2, icr_right=-0.21, icr_x=-0.03),
    "skid_wheels": skid_steer_chassis(SIZE, icr_left=0.2, icr_right=-0.2, motors="wheels"),
    "synchro": synchro_chassis(SIZE),
    "omni": omni_chassis(SIZE, circle=0.15),
    "mecanum": mecanum_chassis(SIZE),
    "wheels": independent_chassis(SIZE, steering="wheels"),
}


class Robot(Rig):
    """Any body; its shafts and servos follow their commands."""

    def __init__(self, kind, **config):
        super().__init__(**config)
        self.chassis = BODIES[kind]
        self.gate = make_gate(chassis=self.chassis, **config)
        self.shafts = [0.0] * len(self.chassis.shafts)
        self.servos = self.chassis.servos(*self.chassis.straight)
        self.turned = 0.0
        self.turns = True
        """The body does what its wheels say."""

    def sense(self):
        show(self.gate, scan(self.now, *self.obstacles))
        heading = -self.turned % (2 * math.pi) if self.turns else 0.0
        show(self.gate, attitude(self.now).model_copy(update={"heading": heading}))
        for shaft, speed in enumerate(self.shafts):
            show(self.gate, feedback(self.now, speed), shaft)
        if self.chassis.steered:
            show(self.gate, SteeringFeedback(**header(self.now), **servo_fields(self.servos)))

    def _obey(self):
        self.shafts, self.servos = list(self.out.speeds), self.out.servos
        self.turned += self.made[2] * 0.02

    @property
    def made(self):
        """Twist that shafts and servos make."""
        angles = self.chassis.steering(*self.servos)
        return self.chassis.twist(self.chassis.input_speeds(tuple(self.shafts), *angles), *angles)
