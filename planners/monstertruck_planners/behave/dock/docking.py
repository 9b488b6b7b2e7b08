"""Behaviours ``dock`` and ``undock``.

Docking perceives the dock's tag from the staging pose, approaches in closed loop on the tag's pose fused over all
images, stands until the battery is charged, and backs off for another attempt if one of these fails.

A robot whose rear docks has no camera there. It looks at the tag from near by, backs off, turns about in two arcs or on
the spot, and reverses to the docked pose in the map: the tag gave that pose relative to the map, and localisation by
scans holds it. Forward approaches use odometry between images, which does not jump.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Generic, Literal, Self, TypeVar

import numpy as np

from monstertruck_kinematics.elementary import Array, KinematicsError
from monstertruck_kinematics.profiles import BasicMove
from monstertruck_kinematics.se2 import Pose2, between, compose, interpolate
from monstertruck_planners.behave.api import BehaviourBody, BehaviourStep, Inputs, RequestedMotion
from monstertruck_planners.behave.dock.config import DockingConfig, UndockConfig, chosen
from monstertruck_planners.behave.dock.estimate import TagEstimate, docked_pose, driven, facing, seen
from monstertruck_planners.behave.move import require_possible
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import DockTarget
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import BATTERY, GATE, ODOMETRY, POSE, TAGS, Topic

Phase = Literal[
    "perceive", "look", "view", "back_off", "turn_out", "turn_in", "approach", "settle", "charge", "retreat"
]

STEERING_LENGTH: Final = 0.1
"""Decay distance (to 1/e) of an error across the axis, a double root (m): critically damped."""
VIEW: Final = 0.15
"""Distance before the docked pose where a robot that docks in reverse looks at the tag (m)."""


class _Turns:
    """How a body turns.

    Args:
        body: body of the robot.

    Raises:
        KinematicsError: the body cannot turn.
    """

    def __init__(self, body: BehaviourBody) -> None:
        body.chassis.possible((1.0, 0.0, 0.1))
        # 1.15: share beyond the minimum radius, for corrections
        steering: Literal["front", "counter"] = "front" if body.chassis.freedom == "front" else "counter"
        self.radius = 1.15 * body.chassis.bicycle.minimum_radius(steering, body.max_angle)
        """Radius of the arcs (m)."""
        try:
            require_possible(BasicMove.spot(1.0), body)
            self.on_the_spot = True
        except KinematicsError:
            self.on_the_spot = False

    def along(self, at: Array, way: int, speed: float, end: int = 1) -> RequestedMotion:
        """Return the motion along the x axis at a pose (3,) relative to it.

        Args:
            at: pose of the robot, turned so that its x axis leads out of one end.
            way: +1 towards that end, -1 away from it.
            speed: m/s.
            end: that end: +1 front, -1 rear.
        """
        bent = curvature(float(at[1]), float(at[2]), way, 1.0 / self.radius)
        return RequestedMotion(way * end * speed, speed * bent)


@dataclass(frozen=True)
class Docking:
    """State between two steps."""

    phase: Phase = "perceive"
    since: float = 0.0
    """Start of the phase (s)."""
    attempt: int = 1
    trail: tuple[tuple[int, Pose2], ...] = ()
    """Stamps (ns) and poses of the robot of the latest seconds."""
    image: int = 0
    """Stamp of the latest image (ns)."""
    seen: float = 0.0
    """Time of the last sighting of the tag (s)."""
    tag: TagEstimate | None = None
    images: int = 0
    """Images of the tag since the start of the phase."""
    rest: float | None = None
    """Voltage at rest on arrival (V)."""


C = TypeVar("C", DockingConfig, UndockConfig)


class AtDock(Generic[C]):
    """Base of the behaviours at a dock.

    Args:
        config: settings of the run.
        body: body of the robot.

    Raises:
        ValueError: no such dock.
        KinematicsError: the body cannot turn.
    """

    reads: ClassVar[tuple[Topic[Any], ...]] = (ODOMETRY, GATE)

    def __init__(self, config: C, body: BehaviourBody) -> None:
        self._config: C = config
        self._name, self._dock = chosen(config.docks, config.dock)
        self._turns = _Turns(body)
        self._reverse = self._dock.direction == "reverse"
        self._end = -1 if self._reverse else 1
        """End of the robot that docks."""

    @classmethod
    def fit(cls, config: C, body: BehaviourBody) -> Self:
        """Return the behaviour for a body; raises the same errors as the class."""
        return cls(config, body)


class Dock(AtDock[DockingConfig]):
    """Docks the robot."""

    may_read: ClassVar[tuple[Topic[Any], ...]] = (TAGS, POSE, BATTERY)

    def begin(self) -> Docking:
        """Return the state before the first step."""
        return Docking()

    def step(self, inputs: Inputs, state: Docking, t: float) -> BehaviourStep:
        """Run one step."""
        here = inputs.if_fresh(POSE) if self._reverse else inputs.of(ODOMETRY)
        if here is None:
            return BehaviourStep(None, state, state.phase, Reason.INPUT_STALE, "no fresh pose in the map")
        state = self._observed(state, here, inputs, t)
        base = np.array(state.trail[-1][1])
        if state.tag is None:
            if t - state.since > self._config.look:
                return self._failed(state, t, Reason.DOCK_NOT_SEEN, self._unseen)
            return BehaviourStep(None, state, state.phase)
        dock = docked_pose(state.tag.mean, self._dock)
        step = self._moved(state, inputs, between(dock, base), t)
        odometry = _pose(inputs.of(ODOMETRY))
        x, y, yaw = compose(odometry, between(base, dock)).tolist()
        target = DockTarget(name=self._name, pose=Pose2D(x=x, y=y, yaw=yaw))
        return replace(step, dock=target, values=self._values(step.state, between(dock, base)))

    @property
    def _unseen(self) -> str:
        return f"tag {self._dock.tag} of dock {self._name} was not seen within {self._config.look:g} s"

    def _observed(self, state: Docking, here: Odometry, inputs: Inputs, t: float) -> Docking:
        """Return the state with the latest pose and image."""
        trail = state.trail
        if not trail or here.stamp > trail[-1][0]:
            x, y, yaw = _pose(here).tolist()
            if state.tag is not None and trail:
                way = math.dist(trail[-1][1][:2], (x, y))
                state = replace(state, tag=driven(state.tag, _pose(here), way))
            # 40: poses kept, 2 s; images are read within that time
            state = replace(state, trail=(*trail[-39:], (here.stamp, (x, y, yaw))))
        poses = inputs.if_fresh(TAGS)
        if poses is None or poses.stamp <= state.image or poses.stamp < state.trail[0][0]:
            return state
        state = replace(state, image=poses.stamp)
        # In reverse an image taken on the move would add the latency of the pose in the map.
        for tag in poses.tags if not self._reverse or state.phase in ("perceive", "look", "view") else ():
            if tag.tag == self._dock.tag:
                stamps, places = np.array([row[0] for row in state.trail]), np.array([row[1] for row in state.trail])
                estimate = seen(state.tag, tag, interpolate(stamps, places, np.array([poses.stamp]))[0])
                state = replace(state, tag=estimate, seen=t, images=state.images + 1)
        return state

    def _moved(self, state: Docking, inputs: Inputs, nose: Array, t: float) -> BehaviourStep:
        """Return the step of the current phase; ``nose`` is base relative to the docked pose that faces the dock."""
        at = facing(nose, self._dock)
        match state.phase:
            case "perceive" | "look" | "view":
                return self._looked(state, nose, t)
            case "back_off" | "turn_out" | "turn_in":
                return self._turned(state, nose, at, t)
            case "approach":
                return self._approached(state, at, t)
            case "settle":
                return self._settled(state, inputs, at, t)
            case "charge":
                return self._charged(state, inputs.if_fresh(BATTERY), t)
            case "retreat":
                return self._retreated(state, at, t)

    def _looked(self, state: Docking, nose: Array, t: float) -> BehaviourStep:
        """Stand until the tag is known well enough to start, or, near the dock, to approach without the camera."""
        assert state.tag is not None
        if state.phase == "look":
            if (left := -float(nose[0]) - VIEW) <= 0.005:
                return self._next(state, "view", t)
            if t - state.seen < self._config.look:
                return self._drive(state, self._turns.along(nose, 1, pace(left, self._config.speed)))
        elif state.images >= (15 if state.phase == "view" else 3) and state.tag.deviation < 0.1:  # images; rad
            following: Phase = "look" if self._reverse else "approach"
            return self._next(state, "back_off" if state.phase == "view" else following, t)
        elif t - state.since < self._config.look:
            return BehaviourStep(None, state, state.phase)
        return self._failed(state, t, Reason.DOCK_NOT_SEEN, self._unseen)

    def _turned(self, state: Docking, nose: Array, at: Array, t: float) -> BehaviourStep:
        """Back off, and turn the rear to the dock: by an arc ahead and one in reverse, which ends where it began."""
        speed, radius, spot = self._config.speed, self._turns.radius, self._turns.on_the_spot
        stopping = 0.3 * speed / radius  # turn while the robot stops, for 0.3 s, rad
        if state.phase == "back_off":
            left = self._dock.staging + (0.0 if spot else 2.0 * radius) + float(nose[0])
            if left > 0.0:
                return self._drive(state, self._turns.along(nose, -1, pace(left, speed)))
            return self._next(state, "turn_in" if spot else "turn_out", t)
        if state.phase == "turn_out":
            if float(nose[2]) < math.pi / 2 - stopping:
                return self._drive(state, RequestedMotion(speed, speed / radius))
            return self._next(state, "turn_in", t)
        if -math.remainder(float(at[2]), math.tau) > stopping:
            return self._drive(state, RequestedMotion(0.0 if spot else -speed, speed / radius))
        return self._next(state, "approach", t)

    def _retreated(self, state: Docking, at: Array, t: float) -> BehaviourStep:
        """Drive back to the staging pose for another attempt."""
        if (left := self._dock.staging + float(at[0])) > 0.0:
            return self._drive(state, self._turns.along(at, -1, pace(left, self._config.speed), self._end))
        if self._reverse:
            return self._next(state, "approach", t)
        return self._next(replace(state, tag=None), "perceive", t)

    def _approached(self, state: Docking, at: Array, t: float) -> BehaviourStep:
        left, across, turn = -float(at[0]), float(at[1]), float(at[2])
        if left <= 0.002:  # stopping distance from the lowest speed, m
            return self._next(state, "settle", t)
        if left < STEERING_LENGTH and abs(predicted(across, turn, left)) > self._config.tolerance:
            text = f"{across * 1000:+.0f} mm and {math.degrees(turn):+.1f} degrees from the axis of {self._name}"
            return self._failed(state, t, Reason.DOCK_MISSED, text)
        if not self._reverse and t - state.seen > 1.0:  # the tag is hidden: stand, s
            if t - state.seen > self._config.look:
                return self._failed(state, t, Reason.DOCK_NOT_SEEN, self._unseen)
            return BehaviourStep(None, state, state.phase)
        return self._drive(state, self._turns.along(at, 1, pace(left, self._config.speed), self._end))

    def _settled(self, state: Docking, inputs: Inputs, at: Array, t: float) -> BehaviourStep:
        """Stand, and compare the pose with the docked one."""
        # 1.0 s: the robot is at rest, and images of it have arrived
        if t - state.since < 1.0:
            return BehaviourStep(None, state, state.phase)
        off, turn = math.hypot(*at[:2]), float(at[2])
        if off > self._config.tolerance or abs(turn) > self._config.turn_tolerance:
            text = f"{off * 1000:.0f} mm and {math.degrees(turn):+.1f} degrees from the dock {self._name}"
            return self._failed(state, t, Reason.DOCK_MISSED, text)
        if self._dock.charging is None:
            return self._done(state, f"docked at {self._name}")
        battery = inputs.if_fresh(BATTERY)
        return self._next(replace(state, rest=None if battery is None else battery.rest_voltage), "charge", t)

    def _charged(self, state: Docking, battery: Battery | None, t: float) -> BehaviourStep:
        signs = self._dock.charging
        assert signs is not None
        if battery is not None:
            rise = None if battery.rest_voltage is None or state.rest is None else battery.rest_voltage - state.rest
            if battery.current is not None and battery.current >= signs.current:
                return self._done(state, f"docked at {self._name}, charging with {battery.current:.1f} A")
            if battery.current is None and rise is not None and rise >= signs.voltage:
                return self._done(state, f"docked at {self._name}, charging: the voltage rose by {rise:.2f} V")
        if t - state.since > signs.within:
            text = f"no sign of charging at {self._name} within {signs.within:g} s"
            return self._failed(state, t, Reason.NOT_CHARGING, text)
        return BehaviourStep(None, state, state.phase)

    def _drive(self, state: Docking, motion: RequestedMotion) -> BehaviourStep:
        return BehaviourStep(motion, state, state.phase)

    def _next(self, state: Docking, phase: Phase, t: float) -> BehaviourStep:
        return BehaviourStep(None, replace(state, phase=phase, since=t, seen=t, images=0), phase)

    def _failed(self, state: Docking, t: float, reason: Reason, text: str) -> BehaviourStep:
        """Try again, or give up."""
        faces = state.phase in ("approach", "settle", "charge") or not self._reverse
        if state.attempt < self._config.attempts and state.tag is not None and faces:
            return self._next(replace(state, attempt=state.attempt + 1), "retreat", t)
        return BehaviourStep(None, state, state.phase, reason, f"{text}, attempt {state.attempt}")

    def _done(self, state: Docking, text: str) -> BehaviourStep:
        return BehaviourStep(None, state, state.phase, Reason.BEHAVIOUR_DONE, text)

    def _values(self, state: Docking, nose: Array) -> dict[str, float]:
        at = facing(nose, self._dock)
        values = {"left": -at[0], "across": at[1], "turn": at[2], "attempt": state.attempt}
        if state.tag is not None:
            values |= {"deviation": state.tag.deviation, "images": state.tag.images}
        return {name: float(value) for name, value in values.items()}


@dataclass(frozen=True, slots=True)
class Undocking:
    """State between two steps."""

    start: Pose2 | None = None
    """Base in odom at the start."""


class Undock(AtDock[UndockConfig]):
    """Drives the robot out of a dock."""

    may_read: ClassVar[tuple[Topic[Any], ...]] = (POSE,)

    def begin(self) -> Undocking:
        """Return the state before the first step."""
        return Undocking()

    def step(self, inputs: Inputs, state: Undocking, t: float) -> BehaviourStep:
        """Run one step."""
        base, located = _pose(inputs.of(ODOMETRY)), inputs.if_fresh(POSE)
        if state.start is None:
            if located is None:
                return BehaviourStep(None, state, "leave", Reason.INPUT_STALE, "no fresh pose in the map")
            x, y, turn = between(np.array((self._dock.x, self._dock.y, self._dock.yaw)), _pose(located)).tolist()
            if math.hypot(x, y) > 0.3 or abs(turn) > 0.3:  # a robot this far from the dock does not stand in it, m, rad
                off = f"{math.hypot(x, y):.2f} m and {abs(math.degrees(turn)):.0f} degrees"
                text = f"the robot is {off} from the dock {self._name}"
                return BehaviourStep(None, state, "leave", Reason.DOCK_MISSED, text)
            x, y, yaw = base.tolist()
            state = Undocking((x, y, yaw))
        assert state.start is not None
        dock = facing(np.array(state.start), self._dock)
        at = between(dock, facing(base, self._dock))
        left = self._dock.staging + float(at[0])
        if left <= 0.01:
            return BehaviourStep(None, state, "leave", Reason.BEHAVIOUR_DONE, f"left the dock {self._name}")
        end = -1 if self._dock.direction == "reverse" else 1
        motion = self._turns.along(at, -1, pace(left, self._config.speed), end)
        x, y, yaw = dock.tolist()
        target = DockTarget(name=self._name, pose=Pose2D(x=x, y=y, yaw=yaw))
        return BehaviourStep(motion, state, "leave", values={"left": left}, dock=target)


def _pose(odometry: Odometry) -> Array:
    return np.array((odometry.pose.x, odometry.pose.y, odometry.pose.yaw))


def curvature(across: float, turn: float, way: float, limit: float) -> float:
    """Return the curvature (1/m) per distance travelled that leads a robot onto an axis.

    Args:
        across: distance to the left of the axis (m).
        turn: heading relative to the axis (rad).
        way: +1 for a robot that drives ahead along the axis, -1 for one that reverses along it.
        limit: maximum curvature (1/m).
    """
    # 0.2: maximum angle to the axis, rad: the camera keeps the tag in view
    towards = min(max(-way * across / (2.0 * STEERING_LENGTH), -0.2), 0.2)
    return min(max(2.0 * (towards - turn) / STEERING_LENGTH, -limit), limit)


def pace(left: float, speed: float) -> float:
    """Return the speed (m/s) with ``left`` metres to a stop; it falls in proportion to the distance.

    0.6 1/s: a robot that responds within 0.3 s does not overshoot. 0.012 m/s: slower set-points do not turn a motor.
    """
    return min(speed, max(0.6 * left, 0.012))


def predicted(across: float, turn: float, left: float) -> float:
    """Return the distance across the axis (m) that is left after ``left`` metres along it, for a small heading."""
    return (across + (turn + across / STEERING_LENGTH) * left) * math.exp(-left / STEERING_LENGTH)
