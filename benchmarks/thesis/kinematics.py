"""5.1 Kinematics: odometry's error and the turning radius for each manoeuvre, whole daemon, open-loop requests.

The truck drives in the empty hall, on the virtual clock and through all emulated devices, with servos in whole degrees.
Truth is the world's. The radius is that of the true poses at constant angles, compared with the formula for the angles
that the servo pulses reach; the formula for the requested angles is shown beside it. The speed ratio is the true
distance over odometry's. The formulas alone: the slip of wheels at 1 m/s if they turned and rolled according to the
formulas, and an axle angle converted by the linkage and back.
"""

import math
from typing import Any

import numpy as np

from benchmarks import scoring
from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.daemon import CONFIGS
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_schemas import topics
from monstertruck_schemas.req import DriveRequest
from monstertruckd.config.load import load_config
from monstertruckd.tools.figures import new_figure, write_figure
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

TRUCK = FourWheelSteering()
SPEED, ANGLE = 0.2, 0.3
START = {"x": 4.0, "y": 0.0, "yaw": 0.0}
QUARTER = math.pi / 2 * TRUCK.wheelbase / (2 * math.tan(ANGLE) * SPEED)
"""Seconds of a right angle in counter steering."""
MANOEUVRES: dict[str, list[tuple[float, float, float]]] = {
    "straight": [(12.0, 0.0, 0.0)],
    "circle_2ws": [(33.0, ANGLE, 0.0)],
    "circle_counter": [(16.0, ANGLE, -ANGLE)],
    "crab": [(12.0, 0.25, 0.25)],
    "figure_eight": [(16.3, ANGLE, -ANGLE), (16.3, -ANGLE, ANGLE)],
    "square": 4 * [(4.0, 0.0, 0.0), (QUARTER, ANGLE, -ANGLE)],
}
"""Seconds, front and rear axle angle, rad, of each leg."""
RADII: dict[str, list[tuple[float, float, float]]] = {
    f"circle_{mode}_{angle}": [(12.0, angle, share * angle)]
    for mode, share in (("2ws", 0.0), ("counter", -1.0))
    for angle in (0.15, 0.25, 0.38)
}
"""Further angles, of which only the radius is looked at."""


def run(options: Options) -> Part:
    part = Part()
    rows = {}
    formulas(part)
    for name, whole in (MANOEUVRES | RADII).items():
        if options.quick and name not in ("straight", "circle_counter"):
            continue
        legs = [(3.0, *whole[0][1:])] if options.quick else whole
        rows[name] = row = drive(legs)
        if name in MANOEUVRES:
            score = scoring.trajectory(row["odometry"], row["truth"])
            part.add(f"{name}.end_share", score["end_m"] / score["driven_m"], 0.02)
            for key in ("ate_m", "end_m", "end_rad", "driven_m"):
                part.add(f"{name}.{key}", score[key])
            part.add(f"{name}.speed_ratio", score["driven_m"] / scoring.length(row["odometry"]))
        _, front, rear = legs[0]
        if name.startswith("circle"):
            reached = radius(*config_of().chassis().reached((front, rear)))
            part.add(f"{name}.radius_m", row["radius"])
            part.add(f"{name}.radius_formula_m", radius(front, rear))
            part.add(f"{name}.radius_reached_m", reached)
            part.add(f"{name}.radius_off_share", abs(row["radius"] / reached - 1.0), 0.05)
    draw(options, rows)
    return part


def radius(front: float, rear: float) -> float:
    """Return the turning radius of the truck's centre by the formula (m)."""
    return float(1.0 / TRUCK.curvature(front, rear))


def formulas(part: Part) -> None:
    """Add the figures that need no drive."""
    front = np.linspace(-0.4, 0.4, 81)
    for mode, rear in (("2ws", 0.0 * front), ("counter", -front), ("crab", front)):
        vx, vy, wz = TRUCK.body_twist(1.0, front, rear)
        slips = []
        angles, speeds = TRUCK.wheel_angles(front, rear), TRUCK.wheel_speeds(1.0, front, rear)
        for (x, y), angle, speed in zip(TRUCK.wheel_positions, angles, speeds, strict=True):
            u, v = vx - wz * y, vy + wz * x
            slips.append(np.hypot(u - speed * np.cos(angle), v - speed * np.sin(angle)))
        part.add(f"formulas.{mode}.slip_max_m_s", float(np.max(slips)), 1e-6)
    for name in ("front", "rear"):
        axle = getattr(SteeringPolynomials(), name)
        there_and_back = axle.axle_from_servo(axle.servo_from_axle(front))
        part.add(f"formulas.{name}_servo_round_trip_rad", float(np.abs(there_and_back - front).max()), 1e-6)


def config_of() -> SimulatedTruckConfig:
    """Return the configuration of the truck."""
    return load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)[0]


def drive(legs: list[tuple[float, float, float]]) -> dict[str, Any]:
    """Return true and estimated poses (n, 3) of the same instants, and the true radius of the first leg."""
    overlay = {
        "path": None,
        "map": None,
        "recorder": None,
        "blackbox": None,
        "sim": {"world": {"map": "hall", "start": START}},
    }
    config = with_overlay(config_of(), overlay | {"odometry": {"start": START}})
    seen: list[tuple[float, ...]] = []

    def note(_topic: object, message: Any, *_: object) -> None:
        seen.append((message.stamp / SECOND, message.pose.x, message.pose.y, message.pose.yaw))

    async def main(clock: VirtualClock) -> np.ndarray:
        rig = VirtualRig(config, clock)
        rig.bus.tap(note, [topics.ODOMETRY])
        async with rig.running():
            await clock.sleep(2.0)
            operator = LocalOperator(rig.daemon, clock)
            await operator.arm()
            for seconds, front, rear in legs:
                for _ in range(round(seconds * 10)):
                    request = DriveRequest(**await operator.header(0.3), speed=SPEED, front=front, rear=rear)
                    rig.bus.inject(topics.REQ_DRIVE, request)
                    await clock.sleep(0.1)
            await clock.sleep(1.5)
            began = rig.began
        true = rig.truth.array()[:, :4]
        true[:, 0] += 0.0 if true[0, 0] >= began / SECOND else began / SECOND
        return true

    true = run_virtual(main)
    estimate = np.array(seen)
    estimate = estimate[(estimate[:, 0] >= true[0, 0]) & (estimate[:, 0] <= true[-1, 0])]
    truth = scoring.at(true[:, 0], true[:, 1:], estimate[:, 0])
    first = truth[(estimate[:, 0] > estimate[0, 0] + 4.0) & (estimate[:, 0] < estimate[0, 0] + 2.0 + legs[0][0])]
    turned = abs(float(np.unwrap(first[:, 2])[-1] - first[0, 2])) if len(first) > 1 else 0.0
    return {
        "truth": truth, "odometry": estimate[:, 1:], "radius": scoring.length(first) / turned if turned > 0.1 else 0.0
    }  # fmt: skip


def draw(options: Options, rows: dict[str, dict[str, Any]]) -> None:
    figure = new_figure(11, 7)
    for axes, (name, row) in zip(figure.subplots(2, 3).flat, rows.items(), strict=False):
        axes.plot(*row["truth"][:, :2].T, color="0.6", lw=3, label="truth")
        axes.plot(*row["odometry"][:, :2].T, color="tab:red", lw=1, label="odometry")
        axes.set_title(name)
        axes.set_aspect("equal", "datalim")
    axes.legend()
    write_figure(figure, options.out / "kinematics.png")
