"""Wall following as published in an arena of the study's kind: methods 1 (with and without FL's 0.05 m) and 2.

The pure steps of the behaviours at 10 Hz, the world's sonars (5 mm + 1 %, 5 % drop-outs), and a robot that follows
the twist asked for within the acceleration of its gate and a lag of 50 ms; no daemon. Both senses, random headings,
odometry with errors of its own. Prints for every method: runs that came to their end, contacts, steady error (RMS
of the side sonar's true distance error on straights from 1 m after a corner), its maximum there (the gap included),
duration, and the jumps of the speeds asked for. The last line is JSON.

    python benchmarks/wall_following.py [--seeds 50] [--model beam] [--method NAME ...] [--figure FILE.png]
"""

import argparse
import json
import math
import sys
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
from wall_parts.arena import Arena, blocked, rays, study

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.behave.api import Behaviour, Inputs, RequestedMotion
from monstertruck_planners.behave.wall.config import WallPdConfig, WallSwitchingConfig
from monstertruck_planners.behave.wall.published import WallPd, WallSwitching
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarEcho, SonarRanges
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import ODOMETRY, SONAR
from monstertruck_sim.world.config import FIVE_SONARS, SonarModelConfig, SonarPlace
from monstertruck_sim.world.sonar import survey

PERIOD, FINE = 0.1, 0.01
LAG: Final = 0.05
ACCELERATION, YAW_ACCELERATION, YAW_RATE = 0.8, 1.0, 1.5
"""Of the robot's gate: m/s^2, rad/s^2, rad/s."""
LIMIT: Final = 600.0
"""Seconds a run may take."""
AFTER: Final = 1.0
"""Metres after a corner from which on a straight counts."""
LAP: Final = {"lap_length": 20.0, "lap_radius": 1.0}
METHODS: Final = ("method-1", "method-1-exact", "method-2")


@dataclass
class Outcome:
    """One run."""

    reason: Reason
    contact: bool
    seconds: float
    errors: Array
    """Of the side sonar's distance on straights, m."""
    jumps: tuple[float, float]
    """Greatest change of v, m/s, and of the yaw rate, rad/s, from one step to the next."""
    track: Array
    """(n, 3): x, y, distance error."""


def behaviour(method: str, side: str) -> Behaviour:
    if method == "method-2":
        return WallSwitching(WallSwitchingConfig.model_validate({"side": side, **LAP}))
    offset = 0.05 if method == "method-1-exact" else 0.0
    return WallPd(WallPdConfig.model_validate({"side": side, "offset": offset, **LAP}))


def mirrored(walls: Array) -> Array:
    return walls * np.array([1.0, -1.0, 1.0, -1.0])


def run(method: str, model: str, side: str, seed: int, arena: Arena) -> Outcome:
    rng = np.random.default_rng(seed)
    walls = arena.walls if side == "left" else mirrored(arena.walls)
    sonar = SonarModelConfig(model=model, dropout=0.05, sonars=FIVE_SONARS)  # type: ignore[arg-type]
    cast, place = partial(rays, walls), FIVE_SONARS["l" if side == "left" else "r"]
    x, y, yaw = float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-math.pi, math.pi))
    scale, drift = 1 + float(rng.normal(0, 0.003)), float(rng.normal(0, 0.0003))
    dead = [x, y, yaw]
    pilot, v, w = behaviour(method, side), 0.0, 0.0
    state, errors, track, asked = pilot.begin(), [], [], []
    contact, reason, t = False, Reason.TIMEOUT, 0.0
    while t < LIMIT:
        heard = survey(cast, (x, y, yaw), sonar, rng)
        step = pilot.step(_inputs(heard, tuple(dead), v, w, sonar), state, t)
        state = step.state
        if step.outcome is not Reason.DRIVING:
            reason = step.outcome
            break
        motion = step.motion or RequestedMotion()
        asked.append(motion[:2])
        for _ in range(round(PERIOD / FINE)):
            v += float(np.clip((motion.vx - v) * FINE / LAG, -ACCELERATION * FINE, ACCELERATION * FINE))
            turn = float(np.clip(motion.wz, -YAW_RATE, YAW_RATE))
            w += float(np.clip((turn - w) * FINE / LAG, -YAW_ACCELERATION * FINE, YAW_ACCELERATION * FINE))
            x, y, yaw = x + v * math.cos(yaw) * FINE, y + v * math.sin(yaw) * FINE, yaw + w * FINE
            dead[2] += w * FINE + drift * v * FINE
            dead[0] += scale * v * math.cos(dead[2]) * FINE
            dead[1] += scale * v * math.sin(dead[2]) * FINE
        contact |= bool(blocked(walls, x, y, yaw))
        error = _error(arena, (x, y if side == "left" else -y, yaw if side == "left" else -yaw), place)
        if step.phase not in ("approach", "stop"):
            track.append((x, y, math.nan if error is None else error))
            if error is not None:
                errors.append(error)
        t += PERIOD
        if contact:
            reason = Reason.OBSTACLE_STOP
            break
    changes = np.abs(np.diff(np.array(asked), axis=0)).max(axis=0) if len(asked) > 1 else np.zeros(2)
    jumps = float(changes[0]), float(changes[1])
    return Outcome(reason, contact, t, np.array(errors), jumps, np.array(track).reshape(-1, 3))


def _inputs(heard: Any, pose: Any, v: float, w: float, sonar: SonarModelConfig) -> Inputs:
    head = {"stamp": 0, "received": 0, "seq": 0}
    echoes = tuple(SonarEcho(name=n, range=r if math.isfinite(r) else None, stamp=0) for n, r in heard.items())
    ranges = SonarRanges(
        **head, sonars=echoes, field_of_view=sonar.field_of_view, range_min=sonar.range_min, range_max=sonar.range_max
    )
    odometry = Odometry(
        **head, frame="odom", pose=Pose2D(x=pose[0], y=pose[1], yaw=pose[2]), twist=Twist2D(vx=v, vy=0.0, wz=w),
        pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0,
    )  # fmt: skip
    return Inputs({SONAR.name: ranges, ODOMETRY.name: odometry})


def _error(arena: Arena, pose: tuple[float, float, float], place: SonarPlace) -> float | None:
    """Error of the side sonar's distance from the line of its wall, of a clockwise lap; None in and near corners."""
    x, y, yaw = pose
    left = abs(place.y)
    at = np.array([
        x + math.cos(yaw) * place.x - math.sin(yaw) * left, y + math.sin(yaw) * place.x + math.cos(yaw) * left
    ])  # fmt: skip
    for a, b in zip(arena.corners, np.roll(arena.corners, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        if math.cos(yaw - math.atan2(along[1], along[0])) < math.cos(0.5):
            continue
        way, off = float((at - a) @ along), float(along[0] * (a - at)[1] - along[1] * (a - at)[0])
        if AFTER <= way <= length - AFTER and 0.0 < off < 1.0:
            return off - 0.30
    return None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--model", choices=("beam", "cone"), default="beam")
    parser.add_argument("--method", choices=METHODS, nargs="+", default=METHODS)
    parser.add_argument("--figure", help="PNG of the first run of every method")
    args = parser.parse_args()
    arena, table, first = study(), {}, {}
    for method in args.method:
        runs = [run(method, args.model, side, s, arena) for s in range(args.seeds) for side in ("left", "right")]
        first[method] = runs[0]
        done = [r for r in runs if r.reason is Reason.BEHAVIOUR_DONE]
        errors = np.concatenate([r.errors for r in done]) * 1000 if done else np.zeros(0)
        table[method] = {
            "runs": len(runs),
            "finished": len(done),
            "contacts": sum(r.contact for r in runs),
            "steady_mm": round(float(np.sqrt(np.mean(errors**2))), 2) if len(errors) else None,
            "worst_mm": round(float(np.abs(errors).max()), 1) if len(errors) else None,
            "worst_median_mm": round(float(np.median([np.abs(r.errors).max() for r in done])) * 1000, 1)
            if done
            else None,
            "seconds": round(float(np.median([r.seconds for r in done])), 1) if done else None,
            "jump_v": round(max(r.jumps[0] for r in runs), 3),
            "jump_w": round(max(r.jumps[1] for r in runs), 3),
            "reasons": {str(reason): sum(r.reason is reason for r in runs) for reason in {r.reason for r in runs}},
        }
        print(method, table[method], flush=True)
    if args.figure:
        _draw(arena, first, args.figure)
    print(json.dumps({"model": args.model, "seeds": args.seeds, "methods": table}))
    return 0


def _draw(arena: Arena, runs: dict[str, Outcome], file: str) -> None:
    figure, axes = plt.subplots(2, len(runs), figsize=(5 * len(runs), 8), squeeze=False)
    for column, (name, outcome) in enumerate(runs.items()):
        for wall in arena.walls:
            axes[0, column].plot(wall[::2], wall[1::2], "k")
        axes[0, column].plot(outcome.track[:, 0], outcome.track[:, 1])
        axes[0, column].set(title=name, aspect="equal", xlabel="x, m", ylabel="y, m")
        axes[1, column].plot(np.arange(len(outcome.track)) * PERIOD, outcome.track[:, 2] * 1000)
        axes[1, column].set(xlabel="s", ylabel="distance error, mm", ylim=(-60, 60))
    figure.tight_layout()
    figure.savefig(file, dpi=80)


if __name__ == "__main__":
    sys.exit(main())
