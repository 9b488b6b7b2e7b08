"""Check of the settings outside the gate that must match its speed; the message names each setting that does not.

With a mismatch the robot would fail later, at a higher speed: its estimated pose would no longer follow its motion, or
its route would end in an unseen obstacle. Speeds are in m/s, distances in m.
"""

from collections.abc import Iterator
from typing import Final

from monstertruck_estimation.consistency.config import MAX_SPEED
from monstertruck_estimation.odometry import OdometrySettings
from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.track.config import TrackerConfig

SPARE: Final = 1.25
"""Factor by which wheel readings may exceed the gate's speed: the times of the readings are uncertain by a fraction of
their period.
"""


def too_slow(
    speed: float,
    odometry: OdometrySettings,
    tracker: TrackerConfig | None,
    planner: PlannerConfig | None,
    slam: SlamConfig | None,
    *,
    consistent: bool,
) -> Iterator[str]:
    """Return every setting that is too low for ``gate.speed``, with its required value.

    Args:
        speed: ``gate.speed`` (m/s).
        odometry: odometry settings.
        tracker: tracker settings; None without a tracker.
        planner: planner settings; None without a planner.
        slam: mapping settings; None without mapping.
        consistent: whether the sensors are compared.
    """
    believed = getattr(odometry, "max_speed", None)
    if believed is not None and believed < SPARE * speed:
        yield f"odometry.max_speed {believed:g} m/s: expected at least {SPARE * speed:g}, {SPARE} times gate.speed"
    if slam is not None and slam.mapper.fastest[0] < SPARE * speed:
        yield f"slam.mapper.fastest {slam.mapper.fastest[0]:g} m/s: expected at least {SPARE * speed:g}"
    if consistent and SPARE * speed > MAX_SPEED:
        most = MAX_SPEED / SPARE
        yield (
            f"gate.speed {speed:g} m/s: at most {most:g}, the limit for the comparison of sensors; or set "
            "consistency to null"
        )
    if planner is None or tracker is None:
        return
    needed = distance_to_stop(min(speed, tracker.speed), planner, tracker)
    sees = [("planner.look_ahead", planner.look_ahead, 1)]
    if planner.local_planner is not None:
        sees.append(("planner.local.window.size", planner.local.window.size, 2))
    for name, metres, share in sees:
        if metres < share * needed:
            yield (
                f"{name} {metres:g} m: expected at least {share * needed:.2f}: the tracker stops within "
                f"{needed:.2f} m after blocked_scans have shown that the route is blocked"
            )


def distance_to_stop(speed: float, planner: PlannerConfig, tracker: TrackerConfig) -> float:
    """Distance travelled from the first scan that shows a blocked route until the tracker stops (m)."""
    noticed = planner.blocked_scans / planner.rate
    return speed * noticed + speed**2 / (2 * tracker.deceleration)
