"""Basic motion control: a move (radius R, length D or angle phi = D/R) driven under a motion profile (lecture, 2013).

Signs follow REP 103: a radius above 0 has the centre on the left, an angle above 0 turns counter-clockwise, a length
below 0 goes backwards. Radius and length refer to the point of the body abeam of the turning centre: on a car the
middle of the rear axle.

The robot first creeps so that its wheels steer to the move. The profile then gives the target distance by a clock. The
clock stops while the robot lags by more than it drives in 0.3 s, because the gate or the motors slow it. ``ramp`` has
no clock: its cubic ramps start from the current speed and acceleration, and the ramp to standstill covers the
remaining distance.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.profiles import BasicMove, CubicProfile, CubicRamp, MotionProfile, TrapezoidalProfile
from monstertruck_kinematics.se2 import Twist2
from monstertruck_planners.behave.api import BehaviourBody, BehaviourConfig, BehaviourStep, Inputs, RequestedMotion
from monstertruck_schemas.base import Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import GATE, ODOMETRY, Topic

LAG: Final = 0.3
"""Lag that every robot has behind its profile (s)."""


class Amounts(NamedTuple):
    """Limits of a move, in metres or, for a turn on the spot, in radians."""

    speed: float
    acceleration: float
    behind: float
    """Distance behind the profile that is never treated as a lag."""
    tolerance: float
    """End tolerance."""


class MoveConfig(BehaviourConfig):
    """Settings of one basic move; ``monstertruckd move`` supplies them with every run."""

    kind: Literal["move"] = "move"
    rate: Annotated[float, Field(gt=0, le=50)] = 20.0
    """Steps per second"""
    radius: float | None = None
    """Radius of the arc, m, centre on the left positive; 0 = on the spot, null: straight"""
    length: float | None = None
    """Distance, m, backwards negative; null: given by the angle"""
    angle: float | None = None
    """Turn, rad, counter-clockwise positive; null: given by the length"""
    bearing: Annotated[float, Field(ge=-math.tau, le=math.tau)] = 0.0
    """Direction of travel in base, rad: 0 = ahead, a quarter turn = sideways to the left"""
    profile: Literal["trapezoid", "cubic", "ramp"] = "trapezoid"
    """Constant acceleration; cubic ramps over time; or cubic ramps from the current speed"""
    speed: Annotated[float, Field(gt=0, le=5)] = 0.15
    """Maximum speed, m/s"""
    acceleration: Annotated[float, Field(gt=0, le=5)] = 0.3
    """Maximum acceleration, m/s^2"""
    turn_rate: Annotated[float, Field(gt=0, le=5)] = 0.4
    """Maximum yaw rate of a turn on the spot, rad/s"""
    turn_acceleration: Annotated[float, Field(gt=0, le=20)] = 0.8
    """Maximum yaw acceleration of a turn on the spot, rad/s^2"""
    tolerance: Annotated[float, Field(gt=0, le=0.5)] = 0.005
    """End tolerance, m"""
    turn_tolerance: Annotated[float, Field(gt=0, le=0.5)] = 0.01
    """End tolerance of a turn on the spot, rad"""

    @model_validator(mode="after")
    def _sane(self) -> Self:
        if self.length is not None or self.angle is not None:
            self.move()
        return self

    def move(self) -> BasicMove:
        """Return the move defined by these settings.

        Raises:
            ValueError: the settings define no move, or more than one.
        """
        if (self.length is None) is (self.angle is None):
            raise ValueError("expected either a length or an angle")
        if 0.0 in (self.length, self.angle):
            raise ValueError("the length or angle is 0: the robot would not move")
        try:
            if self.angle is None:
                assert self.length is not None
                return (
                    BasicMove.straight(self.length, self.bearing)
                    if self.radius is None
                    else BasicMove.arc(self.radius, self.length, self.bearing)
                )
            if self.radius is None:
                raise ValueError("an angle needs a radius: 0 turns on the spot")
            return (
                BasicMove.spot(self.angle)
                if self.radius == 0.0
                else BasicMove.arc(self.radius, self.radius * self.angle, self.bearing)
            )
        except KinematicsError as error:
            raise ValueError(str(error)) from error

    @property
    def amounts(self) -> Amounts:
        """Limits of the move."""
        if self.radius == 0.0:
            return Amounts(self.turn_rate, self.turn_acceleration, 0.03, self.turn_tolerance)
        return Amounts(self.speed, self.acceleration, 0.01, self.tolerance)


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a move between two steps; distances in m, of a turn on the spot in rad."""

    phase: Literal["steer", "drive", "arrive"] = "steer"
    pose: Odometry | None = None
    covered: float = 0.0
    turned: float = 0.0
    """Accumulated turn, not wrapped (rad)."""
    time: float = 0.0
    """Time of the last step (s)."""
    steered: float | None = None
    """Time since which the wheels are steered to the move (s)."""
    clock: float = 0.0
    """Profile time (s)."""
    target: float = 0.0
    """Target distance."""
    planned: float = 0.0
    """Target speed."""
    ramp: CubicRamp | None = None
    ramp_clock: float = 0.0
    braking: bool = False
    best: float = 0.0
    """Distance covered at the last progress."""
    best_at: float = 0.0
    """Time of the last progress (s)."""
    stood: float = 0.0
    """Time for which the clock was stopped (s)."""


class Move:
    """Basic move of one body.

    Args:
        config: settings of the move.
        body: body of the robot.

    Raises:
        KinematicsError: the body cannot do this move; the message gives the reason.
        ValueError: the settings define no move.
    """

    reads: ClassVar[tuple[Topic[Any], ...]] = (ODOMETRY, GATE)

    def __init__(self, config: MoveConfig, body: BehaviourBody) -> None:
        self._move, self._amounts = config.move(), config.amounts
        self._direction = self._move.direction
        self._twist = require_possible(self._move, body)
        """Twist of base at unit pace."""
        self._chassis = body.chassis
        self._distance = self._move.profile_distance
        self._turns = self._move.radius != 0.0 and body.chassis.freedom != "parallel"
        """Whether turning corrects the heading."""
        self._profile = _profile(config, self._distance)

    @classmethod
    def fit(cls, config: MoveConfig, body: BehaviourBody) -> Self:
        """Return the move for a body; raises the same errors as the class."""
        return cls(config, body)

    def begin(self) -> Progress:
        """Return the state before the first step."""
        return Progress()

    def step(self, inputs: Inputs, state: Progress, t: float) -> BehaviourStep:
        """Run one step."""
        odometry, gate = inputs.of(ODOMETRY), inputs.of(GATE)
        dt = t - state.time
        state = replace(self._advanced(state, odometry), time=t)
        if state.phase == "steer":
            steered = gate.twist is not None and self._steered(gate.twist)
            since = (t if state.steered is None else state.steered) if steered else None
            state = replace(state, steered=since)
            # 0.3: time for which the gate must command the move's direction, because servos respond late, s
            if since is None or t - since < 0.3:
                if t > 4.0:  # seconds
                    return self._ended(state, Reason.NOT_OBEYED, "the wheels cannot reach the move's steering angles")
                # 0.02: speed while the wheels steer, as a fraction of the move's speed: above the standstill threshold
                return self._going(state, math.copysign(0.02 * self._amounts.speed, self._distance))
            state = replace(
                state, phase="drive", target=state.covered, best=state.covered, best_at=t, clock=self._begun(state)
            )
        state = self._planned(state, self._pace(odometry.twist), dt)
        if abs(state.covered - state.best) > self._amounts.tolerance / 2:
            state = replace(state, best=state.covered, best_at=t)
        waited = t - state.best_at
        left = self._distance - state.covered
        stands = abs(self._pace(odometry.twist)) * LAG <= self._amounts.tolerance
        if state.phase == "arrive" and abs(left) <= self._amounts.tolerance and stands:
            way = "" if self._move.radius == 0.0 else f"{state.covered:.3f} m, "
            return self._ended(state, Reason.BEHAVIOUR_DONE, f"{way}turned {state.turned:.3f} rad")
        # 3.0: time without progress after which the move is given up or its end is missed, s
        if waited > 3.0:
            unit = "rad" if self._move.radius == 0.0 else "m"
            reason = Reason.GOAL_MISSED if state.phase == "arrive" else Reason.STUCK
            return self._ended(state, reason, f"{left:.3f} {unit} left and no progress for {waited:.1f} s: {gate.why}")
        off = state.target - state.covered
        usual = LAG * abs(state.planned)
        beyond = off - min(max(off, -usual), usual)
        # 2.0: correction speed per distance from the target, 1/s
        return self._going(state, state.planned + 2.0 * beyond)

    def _advanced(self, state: Progress, now: Odometry) -> Progress:
        """Return the state with the motion since the last step added."""
        before = state.pose
        if before is None:
            return replace(state, pose=now)
        turn = math.remainder(now.pose.yaw - before.pose.yaw, math.tau)
        along = before.pose.yaw + turn / 2 + self._move.bearing
        dx, dy = now.pose.x - before.pose.x, now.pose.y - before.pose.y
        moved = turn if self._move.radius == 0.0 else dx * math.cos(along) + dy * math.sin(along)
        return replace(state, pose=now, covered=state.covered + moved, turned=state.turned + turn)

    def _pace(self, twist: Twist2D) -> float:
        """Speed along the move, m/s or rad/s."""
        ahead, aside, turning = self._direction
        return twist.wz * turning if self._move.radius == 0.0 else twist.vx * ahead + twist.vy * aside

    def _steered(self, commanded: Twist2D) -> bool:
        """Whether the commanded motion has the move's direction."""
        pace = self._pace(commanded)
        if pace * self._distance <= 0.0:
            return False
        vx, vy, wz = self._twist
        off = max(abs(commanded.vx / pace - vx), abs(commanded.vy / pace - vy))
        steered = 0.03  # tolerance between two equal directions, 1/m and rad
        return off <= steered and abs(commanded.wz / pace - wz) <= steered * (1.0 + abs(wz))

    # The profile

    def _begun(self, state: Progress) -> float:
        """Return the profile time that corresponds to the distance covered by creeping."""
        if self._profile is None or self._profile.duration == 0.0:
            return 0.0
        times = np.linspace(0.0, self._profile.duration, 1000)
        covered = np.abs(self._profile.position(times))
        return float(times[min(int(np.searchsorted(covered, abs(state.covered))), len(times) - 1)])

    def _planned(self, state: Progress, pace: float, dt: float) -> Progress:
        """Return the state with the current target distance and speed."""
        behind = (state.target - state.covered) * math.copysign(1.0, self._distance)
        lags = behind > self._amounts.behind + LAG * abs(state.planned)
        if state.phase == "arrive":
            return state
        if self._profile is None:
            return self._ramped(replace(state, stood=state.stood + dt * lags), pace, dt, lags=lags)
        clock = state.clock if lags else state.clock + dt
        at = np.array([min(clock, self._profile.duration)])
        done = clock >= self._profile.duration
        return replace(
            state,
            clock=clock,
            stood=state.stood + dt * lags,
            target=self._distance if done else float(self._profile.position(at)[0]),
            planned=0.0 if done else float(self._profile.speed(at)[0]),
            phase="arrive" if done else "drive",
        )

    def _ramped(self, state: Progress, pace: float, dt: float, *, lags: bool) -> Progress:
        """Return the same by ramps from the current speed and acceleration; a lagging robot uses its actual speed."""
        top, hardest = math.copysign(self._amounts.speed, self._distance), self._amounts.acceleration
        if lags:
            state = replace(state, target=state.covered, planned=pace, ramp=None, braking=False)
        ramp, clock = state.ramp, state.ramp_clock + dt
        if ramp is None:
            change = abs(top - state.planned)
            ramp, clock = CubicRamp(state.planned, top, max(1.5 * change / hardest, dt)), dt
        speed = ramp.speed(clock)
        left = self._distance - state.target
        braking = state.braking
        if not braking and abs(left) <= 0.75 * speed**2 / hardest + abs(speed) * dt and speed * left > 0.0:
            ramp, clock, braking = CubicRamp.to_rest(speed, left, ramp.acceleration(clock)), 0.0, True
        if braking and clock >= ramp.duration:
            return replace(state, phase="arrive", target=self._distance, planned=0.0)
        target = state.target + 0.5 * (state.planned + speed) * dt
        return replace(state, target=target, planned=speed, ramp=ramp, ramp_clock=clock, braking=braking)

    # Results

    def _going(self, state: Progress, pace: float) -> BehaviourStep:
        pace = min(max(pace, -self._amounts.speed), self._amounts.speed)
        ahead, aside, turning = (pace * part for part in self._direction)
        if self._turns and state.phase != "steer":
            # 1.5: curvature per heading error, 1/(m rad)
            turning += abs(pace) * 1.5 * (state.covered * self._direction[2] - state.turned)
        vx, vy, wz = self._chassis.possible((ahead, aside, turning))
        return BehaviourStep(RequestedMotion(vx, wz, vy), state, state.phase, values=self._values(state))

    def _ended(self, state: Progress, outcome: Reason, text: str) -> BehaviourStep:
        return BehaviourStep(None, state, state.phase, outcome, text, self._values(state))

    def _values(self, state: Progress) -> dict[str, float]:
        return {
            "covered": state.covered,
            "left": self._distance - state.covered,
            "turned": state.turned,
            "planned": state.planned,
            "stood": state.stood,
        }


def _profile(config: MoveConfig, distance: float) -> MotionProfile | None:
    """Return the motion profile; None for ramps."""
    amounts = config.amounts
    if config.profile == "ramp":
        return None
    if config.profile == "trapezoid":
        return TrapezoidalProfile(distance, amounts.speed, amounts.acceleration)
    return CubicProfile(distance, amounts.speed, 1.5 * amounts.speed / amounts.acceleration)


def require_possible(move: BasicMove, body: BehaviourBody) -> Twist2:
    """Return the twist of base at unit pace for a move that the body can do.

    Raises:
        KinematicsError: the body cannot do the move; the message gives the reason.
    """
    chassis = body.chassis
    twist = chassis.possible(move.direction)
    angles, clipped = chassis.limited_steering(chassis.steering_for(twist, chassis.straight), body.max_angle)
    reached = chassis.reached(angles)
    # 0.01: tolerance between a reached and a requested axle angle, rad
    if clipped or max((abs(a - b) for a, b in zip(angles, reached, strict=True)), default=0.0) > 0.01:
        vx, vy, wz = chassis.along(twist, *reached)
        if math.isinf(move.radius):
            raise KinematicsError(
                f"bearing is {move.bearing:g} rad: this body's axles reach {math.atan2(vy, vx):.3g} rad"
            )
        raise KinematicsError(f"radius is {move.radius:g} m: this body's axles reach {abs(vx / wz):.3g} m")
    return twist
