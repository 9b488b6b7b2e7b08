"""Squares: what each error does to them."""

import math

import numpy as np
import pytest

from monstertruckd.tools.calibrate.odometry import Square, SquareModel
from monstertruckd.tools.calibrate.steering_model import SteeringModel, SteeringRun
from tests.calibration_light import AHEAD, CHASSIS, MAPS

MODEL = SquareModel(SteeringModel(CHASSIS), MAPS, AHEAD)
RIGHT = np.array((1.0, 1.0, 0.0))


def leg(way, angle, parameters):
    servos = CHASSIS.servos(angle, -angle)
    motor = np.full(50, CHASSIS.drivetrain.motor_rate(way) / 50)
    front, rear = (np.full(50, float(MAPS.pulses(axle, np.array(servos[axle])))) for axle in (0, 1))
    run = SteeringRun(motor, (front, rear), 0.0, 0.003)
    turn = float(MODEL.turns([run], parameters)[0])
    return SteeringRun(motor, (front, rear), turn, 0.003)


def square(sense, parameters, quarter=math.pi / 2):
    whole = leg(1.0, sense * 0.35, parameters).turn
    corner = sense * quarter / whole
    legs = tuple(leg(way, angle, parameters) for _ in range(4) for way, angle in ((1.5, 0.0), (corner, sense * 0.35)))
    return Square(legs, 1.5 * parameters[0], MODEL.end(Square(legs, 0.0, (0.0, 0.0)), parameters))


def test_a_square_of_right_angles_closes():
    x, y = MODEL.end(square(1, RIGHT), RIGHT)
    assert math.hypot(x, y) < 0.01


def test_an_offset_turns_both_squares_in_the_same_sense_and_a_wheelbase_in_opposite_ones():
    offset, base = np.array((1.0, 1.0, 0.02)), np.array((1.0, 1.05, 0.0))
    for parameters, same in ((offset, True), (base, False)):
        left, right = (
            MODEL.turns(square(sense, RIGHT).legs, parameters).sum() - sense * 2 * math.pi for sense in (1, -1)
        )
        assert bool(left * right > 0) is same


def test_errors_are_found():
    true = np.array((1.03, 0.97, 0.02))
    fit = MODEL.fit([square(1, true), square(-1, true)], 0.002, 0.0035)
    assert fit.parameters == pytest.approx(true, abs=0.002)
