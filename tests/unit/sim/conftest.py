"""An open field, a truck that is given pulses and speeds directly, and no noise unless asked for."""

from math import degrees

import numpy as np
import pytest

from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap, save_map
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import ServoModelConfig, WorldConfig
from monstertruck_sim.world.world import World

SECOND = 1_000_000_000
RPM_PER_SPEED = 644 / (2 * np.pi * 0.075) * 60


class Driver:
    """Hands on motor and servos; ``now`` is where its time stands."""

    def __init__(self, world):
        self.world = world
        self.now = 7 * SECOND
        self.pulses = {0: None, 1: None}
        world.servos.attach(self)
        world.truth(self.now)

    def pulse_us(self, channel, time_ns):
        assert time_ns <= self.now + SECOND
        return self.pulses[channel]

    def steer(self, front, rear):
        """Nominal pulses for two axle angles."""
        self.world.servos.advance(self.now)
        for channel, angle in zip((1, 0), SteeringPolynomials().servo_from_axles(front, rear), strict=True):
            servo = ServoModelConfig(channel=channel)
            self.pulses[channel] = servo.centre_us + servo.us_per_degree * degrees(angle)

    def drive(self, speed, acceleration=20_000.0):
        """Wheel speed in m/s, forwards positive; None = power off."""
        target = None if speed is None else -speed * RPM_PER_SPEED
        self.world.motors[0].command(self.now, target, acceleration)

    def wait(self, seconds):
        self.now += round(seconds * SECOND)
        return self.world.truth(self.now)


@pytest.fixture
def field(tmp_path):
    """Make a world on a 12 m x 12 m field around the origin; ``walls`` are (x0, y0, x1, y1) in metres."""

    def make(*, walls=(), seed=1, noise=False, start=(0.0, 0.0, 0.0), **config):
        cells = np.full((240, 240), FREE, np.int8)
        for x0, y0, x1, y1 in walls:
            rows = slice(round((y0 + 6) / 0.05), round((y1 + 6) / 0.05))
            cells[rows, round((x0 + 6) / 0.05) : round((x1 + 6) / 0.05)] = OCCUPIED
        save_map(WorldMap(cells, 0.05, (-6.0, -6.0)), tmp_path / "field.yaml")
        pose = Pose2D(x=start[0], y=start[1], yaw=start[2])
        return Driver(World(WorldConfig(map=str(tmp_path / "field.yaml"), start=pose, noise=noise, **config), seed))

    return make
