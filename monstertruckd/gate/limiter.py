"""Moves the commanded motion towards the request at each tick, within the minimum of all limits."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from monstertruck_kinematics.chassis import STILL, Speeds
from monstertruck_kinematics.se2 import Twist2
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruckd.gate.approach import stopping
from monstertruckd.gate.checks import Check, GateView, PaceLimit
from monstertruckd.gate.motion import ROUNDING, Course, Target, scaled


class Aim(NamedTuple):
    """Motion requested at a tick, as far as the steering permits it so far."""

    target: Target
    wanted: Twist2
    """Twist of the base."""
    shafts: Speeds | None
    """Open-loop speeds of the driven shafts, m/s; None otherwise."""
    passing: bool
    """Whether a change of direction must first pass through standstill."""
    pace: float
    """Pace of ``wanted``, m/s."""
    max_pace: float
    """Maximum pace allowed in the direction of ``wanted``, m/s."""


class CommandLimiter(Check):
    """Advances the commanded motion; as a check, it applies the limits of the body and the configuration.

    Args:
        view: limits, samples and the commanded motion, which the limiter changes.
    """

    reasons = (Reason.SERVO_LIMIT, Reason.CLIPPED)

    def __init__(self, view: GateView) -> None:
        super().__init__(view)
        self._aim: Aim | None = None

    def aim(self, now: int, dt: float, request: DriveRequest | None) -> tuple[Course, ...] | None:
        """Steer for ``dt`` s towards the angles of ``request``; return the motions to be checked.

        These are the requested and the commanded motion, except those at standstill; None without a request.
        """
        motion = self.view.motion
        if request is None:
            motion.halt()
            self._aim = None
            return None
        target = motion.target(request)
        turning = motion.aligned(target.angles)
        if turning or (motion.standing and self.view.samples.at_rest(now)):
            motion.steer(target.angles, dt)
        shafts = target.shafts
        wanted = STILL if not turning else motion.along(target.twist) if shafts is None else target.twist
        passing = motion.reverses(wanted, shafts)
        if passing:
            wanted, shafts = STILL, None
        pace = motion.pace(wanted, shafts)
        max_pace = motion.max_pace(wanted, shafts) if pace > 0 else motion.max_pace(motion.twist)
        self._aim = Aim(target, wanted, shafts, passing, pace, max_pace)
        if pace == 0 and motion.standing:
            return ()
        courses = ((wanted, pace), (motion.twist, motion.present_pace))
        least = 1e-6  # pace below which a motion is standstill, m/s: the direction of such a twist is rounding error
        return tuple((scaled(twist, 1.0 / pace), pace) for twist, pace in courses if twist != STILL and pace >= least)

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Limits for requests beyond the range of the servos or the configured limits."""
        if (aim := self._aim) is None:
            return
        if aim.target.saturated:
            yield PaceLimit(Reason.SERVO_LIMIT, aim.max_pace)
        if aim.target.clipped or aim.pace > aim.max_pace * (1 + ROUNDING):
            yield PaceLimit(Reason.CLIPPED, aim.max_pace)

    def advance(self, dt: float, limits: dict[Reason, float]) -> None:
        """Change the commanded motion towards the aim for ``dt`` s, within ``limits`` (m/s)."""
        if (aim := self._aim) is None:
            return
        motion = self.view.motion
        allowed = min((*limits.values(), aim.max_pace))
        factor = 1.0 if aim.pace <= allowed else allowed / aim.pace
        if allowed == 0:
            motion.halt()
        elif aim.passing:
            motion.slow_down(dt)
        elif aim.shafts is not None:
            motion.turn_shafts(tuple(factor * speed for speed in aim.shafts), dt)
        else:
            motion.accelerate(scaled(aim.wanted, factor), dt)

    def stopping_distance(self, now: int) -> float:
        """Distance travelled if the truck stops now (m), from the greater of the measured and the commanded speed."""
        config = self.view.config
        speed = max(abs(self.view.samples.speed(now) or 0.0), *map(abs, self.view.motion.shaft_speeds))
        fastest = 1e6  # limit of measured speeds, m/s, so that their squares stay finite
        return stopping(min(speed, fastest), config.reaction, config.deceleration)
