"""The truck's linkage: its wheels' motion at given axle angles, against the body model of odometry, gate and trackers.

Axle angles are those by the mean of the wheels' tangents, curvatures those of the wheels' least-squares motion
(``common_motion``). The model is compared with it over the whole range of both servos. Calibrations of trucks with
other linkages are measured by ``benchmarks/calibration.py``.
"""

import math

import numpy as np

from benchmarks.navigation_parts import Options, Part
from monstertruck_kinematics.linkage import common_motion, dragged_speeds
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering, LinkedAxles
from monstertruck_planners.route.api import Vehicle

KNOWN = {(0.4, -0.4): 2.37, (0.36, -0.36): 2.15, (0.4, 0.0): 1.23}
"""Curvatures by the published polynomials, 1/m, by the angles of front and rear axle, rad."""
FULL = (0.4, -0.4)
SERVOS = np.meshgrid(np.linspace(-0.78, 0.78, 41), np.linspace(-0.78, 0.78, 41))
"""Angles of front and rear servo, rad."""


def run(_options: Options) -> Part:
    part = Part()
    bicycle, polynomials = FourWheelSteering(), SteeringPolynomials()
    axles = LinkedAxles(bicycle, polynomials.front, polynomials.rear)
    off = []
    for angles, known in KNOWN.items():
        turned = bicycle.curvature(*axles.angles(*polynomials.servo_from_axles(*angles)))
        ideal = bicycle.curvature(*angles)
        print(f"axles {angles[0]:g} / {angles[1]:g}: {turned:.3f} 1/m (known {known}), ideal wheels {ideal:.3f}")
        off.append(abs(turned - known))
    part.add("off_known_curvatures_max", max(off), 6e-3)
    slide, turn, _ = common_motion(bicycle, axles.wheel_angles(*SERVOS))
    by_model = axles.angles(*SERVOS)
    part.add(
        "curvature_off_max", float(abs(bicycle.curvature(*by_model) - turn * np.cos(np.arctan(slide))).max()), 1e-9
    )
    part.add("sideslip_off_max", float(abs(np.tan(bicycle.sideslip(*by_model)) - slide).max()), 1e-9)
    dragged = np.mean(dragged_speeds(bicycle, np.ones_like(SERVOS[0]), axles.wheel_angles(*SERVOS)), axis=0)
    motor = bicycle.drive_speed(np.ones_like(SERVOS[0]), *by_model)
    part.add("motor_speed_off_max", float(abs(motor / dragged - 1).max()), 2e-3)
    servos = polynomials.servo_from_axles(*FULL)
    part.add("motor_over_body_at_full_lock", float(bicycle.drive_speed(1.0, *axles.angles(*servos))))
    radius = 1 / bicycle.curvature(*axles.angles(*servos))
    part.add("least_radius_4ws_m", radius)
    part.add("least_radius_of_routes_off_m", math.fabs(Vehicle.truck("4ws").radius - radius), 2e-3)
    return part
