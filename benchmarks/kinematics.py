"""Kinematics: the library against a plain numpy script of the same formulas, and the calls of a control tick.

    python benchmarks/kinematics.py

The last line is one JSON object with the figures, the goals and whether all are met.
"""

import json
import statistics
import sys
import timeit
from collections.abc import Callable

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering

STATES = 1_000_000
ROUNDS = 31
LENGTH, FRONT_ARM, REAR_ARM = 0.32, 0.16, 0.16


def script_forward(speed: Array, front: Array, rear: Array) -> tuple[Array, Array, Array]:
    tan_f, tan_r = np.tan(front), np.tan(rear)
    tan_b = (REAR_ARM * tan_f + FRONT_ARM * tan_r) / LENGTH
    vx = speed / np.sqrt(1.0 + tan_b * tan_b)
    return vx, vx * tan_b, vx * (tan_f - tan_r) / LENGTH


def script_inverse(vx: Array, vy: Array, wz: Array) -> tuple[Array, Array, Array]:
    speed = np.copysign(1.0, vx) * np.hypot(vx, vy)
    return speed, np.arctan((vy + FRONT_ARM * wz) / vx), np.arctan((vy - REAR_ARM * wz) / vx)


def ratio(ours: Callable[[], object], theirs: Callable[[], object]) -> tuple[float, float, float]:
    """Return the median times of both (s), run in turns so that load affects both equally, and their median ratio."""
    pairs = [(timeit.timeit(ours, number=1), timeit.timeit(theirs, number=1)) for _ in range(ROUNDS)]
    mine, script = (statistics.median(column) for column in zip(*pairs, strict=True))
    return mine, script, statistics.median(a / b for a, b in pairs)


def microseconds(call: Callable[[], object]) -> float:
    return min(timeit.repeat(call, number=2000, repeat=7)) / 2000 * 1e6


def main() -> int:
    rng = np.random.default_rng(1)
    geometry, steering = FourWheelSteering(LENGTH), SteeringPolynomials()
    speed, front, rear = rng.uniform(-0.2, 0.2, STATES), *rng.uniform(-0.4, 0.4, (2, STATES))
    twist = script_forward(speed, front, rear)
    figures: dict[str, float] = {}
    for name, ours, theirs in (
        (
            "forward",
            lambda: geometry.body_twist(speed, front, rear),
            lambda: script_forward(speed, front, rear),
        ),
        ("inverse", lambda: geometry.steer_for_twist(*twist), lambda: script_inverse(*twist)),
    ):
        mine, script, factor = ratio(ours, theirs)
        print(f"{name}: {mine * 1e3:.1f} ms, script {script * 1e3:.1f} ms, {factor:.3f} x, {STATES} states")
        figures[f"{name}_over_script"] = round(factor, 3)
    for name, call in (
        ("body_twist", lambda: geometry.body_twist(0.2, 0.3, -0.2)),
        ("steer_for_twist", lambda: geometry.steer_for_twist(0.2, 0.01, 0.3)),
        ("limit_keeping_curvature", lambda: geometry.limit_keeping_curvature(0.5, -0.2, 0.4)),
        ("wheel_speeds", lambda: geometry.wheel_speeds(0.2, 0.3, -0.2)),
        ("servo_from_axle", lambda: steering.front.servo_from_axle(0.4)),
        ("axle_from_servo", lambda: steering.front.axle_from_servo(0.6)),
        ("integrate", lambda: geometry.integrate((0.0, 0.0, 0.0), 0.2, 0.0, 0.3, 0.02)),
    ):
        figures[f"{name}_us"] = round(microseconds(call), 2)
        print(f"{name}: {figures[f'{name}_us']:.2f} us")
    goals = {name: 15.0 if name.endswith("_us") else 1.2 for name in figures}
    met = all(figures[name] <= goals[name] for name in goals)
    print(json.dumps({"bench": "kinematics", "figures": figures, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
