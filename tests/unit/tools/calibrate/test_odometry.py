"""Squares: what each error does to them."""

import asyncio
import math

import numpy as np
import pytest

from monstertruck_schemas.sensor import Attitude, DriveFeedback, DriveMode, SteeringFeedback
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.odometry import OdometryWizard, Square, SquareModel, intervals
from monstertruckd.tools.calibrate.steering_model import SteeringModel, SteeringRun
from monstertruckd.tools.calibrate.steps import MoveRecord
from tests.calibration_light import AHEAD, CHASSIS, MAPS
from tests.calibration_robots import CONFIGS

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


def test_the_wheelbase_is_no_surer_than_wheels_that_are_steered_on_the_spot_let_it_be():
    squares = [square(1, RIGHT), square(-1, RIGHT)]
    _, base, _ = intervals(MODEL.fit(squares, 0.002, 0.0035), 16 + 6)
    context = Bent(0.0)
    row = OdometryWizard().judge(context, MAPS, squares).estimate("wheelbase")
    half = (row.high - row.low) / 2 / context.config.geometry.wheelbase
    assert half == pytest.approx(math.hypot(base.half, 0.004, 0.004), rel=0.05), "and than another linkage"


class Bent:
    """A truck whose straights bend to the left, by so many rad on a side of the square."""

    def __init__(self, bend):
        self.chassis, self.config = CHASSIS, load_config(CONFIGS / "truck.yaml", TruckConfig)[0]
        self.turned, self.known, self._bend = [], {}, bend

    async def confirm(self, step):
        return True

    async def ask(self, step):
        return 1.5

    def fit(self, name, function):
        return None

    def plot(self, plot):
        assert plot.points.shape == (2, 2), "squares"

    async def move(self, step):
        record = MoveRecord(left=10, arrived=1000)
        turn = 0.0
        self._read(record, 0, turn)
        if step.done is None:
            turn = self._bend
        else:
            while not step.done(record):
                turn += math.copysign(0.01, step.front)
                self._read(record, 500, turn)
        self._read(record, 1001, turn)
        self.turned.append(turn)
        return record

    @staticmethod
    def _read(record, stamp, turn):
        header = {"stamp": stamp, "received": stamp, "seq": 0}
        for _ in range(5):
            record.attitude.append(Attitude(**header, heading=-turn % math.tau, roll=0.0, pitch=0.0))
        record.drive.append(DriveFeedback(**header, position=0.1 * stamp, velocity=1.0, mode=DriveMode.ENABLED))
        record.steering.append(SteeringFeedback(**header, front=0.0, rear=0.0))


@pytest.mark.parametrize("bend", [0.2, -0.2])
def test_corners_make_up_for_sides_that_bend(bend):
    truck = Bent(bend)
    asyncio.run(OdometryWizard()(truck))
    left, right = truck.turned[:8], truck.turned[8:]
    for turns, sense in ((left, 1), (right, -1)):
        assert np.cumsum(turns)[1::2] == pytest.approx(sense * np.arange(1, 5) * math.pi / 2, abs=0.02)
