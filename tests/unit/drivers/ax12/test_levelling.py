"""The whole loop on the virtual clock: a rocking body, a compass, goals, the driver, both emulated servos."""

import math

import numpy as np
import pytest

from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_planners.behave.stabiliser import StabiliserConfig, StabiliserService
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.sensor import Attitude
from monstertruck_schemas.state import Odometry
from tests.unit.drivers.ax12.rig import FAST, Rig, bench
from tests.unit.drivers.kit import background

pytestmark = pytest.mark.virtual

DELAY = 0.04
"""Age of a compass reading when it comes, s."""


class Goals:
    """Publisher into the driver's mailbox."""

    def __init__(self, mailbox: Mailbox[StabiliserCommand]) -> None:
        self._mailbox = mailbox
        self._seq = 0

    def next_seq(self) -> int:
        self._seq += 1
        return self._seq - 1

    def put(self, message: StabiliserCommand) -> None:
        self._mailbox.put(message)


def body(time_ns: int, amplitude: float, frequency: float) -> tuple[float, float]:
    """Roll and pitch, rad, of a body that circles."""
    phase = math.tau * frequency * time_ns / SECOND
    return -amplitude * math.cos(phase), amplitude * math.sin(phase)


async def compass(rig: Rig, out: Mailbox[Attitude], amplitude: float, frequency: float) -> None:
    """20 readings a second, 0.1 degrees of noise and of resolution."""
    rng = np.random.default_rng(4)
    while True:
        stamp = rig.clock.now()
        true = np.degrees(body(stamp, amplitude, frequency))
        roll, pitch = np.radians(np.round(true + 0.1 * rng.standard_normal(2), 1))
        await rig.settle(DELAY)
        now = rig.clock.now()
        out.put(Attitude(stamp=stamp, received=now, seq=0, heading=0.0, roll=float(roll), pitch=float(pitch)))
        await rig.settle(0.05 - DELAY)


def tilt_of_lidar(roll: float, pitch: float, joint_pitch: float, joint_roll: float) -> float:
    """Angle between the lidar's up axis and the vertical, rad."""
    x, y = math.sin(joint_pitch) * math.cos(joint_roll), -math.sin(joint_roll)
    z = math.cos(joint_pitch) * math.cos(joint_roll)
    z = y * math.sin(roll) + z * math.cos(roll)
    return math.acos(min(1.0, z * math.cos(pitch) - x * math.sin(pitch)))


def off_level(config: Ax12Config, amplitude: float, frequency: float, **bus) -> tuple[float, float]:
    """RMS and greatest tilt of the lidar, degrees, over ten seconds."""

    async def main(clock: VirtualClock) -> list[float]:
        tilts: list[float] = []
        async with bench(clock, config, **bus) as rig:
            readings: Mailbox[Attitude] = Mailbox(latest())
            moved: Mailbox[Odometry] = Mailbox(latest())
            service = StabiliserService(StabiliserConfig(), clock, readings, moved, Goals(rig.commands))
            async with (
                rig.driving(),
                background(compass(rig, readings, amplitude, frequency)),
                background(service.run(lambda: None)),
            ):
                await rig.settle(2)
                for _ in range(1000):
                    await rig.settle(0.01)
                    roll, pitch = body(clock.now(), amplitude, frequency)
                    tilts.append(tilt_of_lidar(roll, pitch, rig.joint("pitch"), rig.joint("roll")))
        return tilts

    tilts = np.degrees(run_virtual(main))
    return float(np.sqrt(np.mean(tilts**2))), float(tilts.max())


def test_a_body_that_rocks_by_15_degrees_carries_a_level_lidar():
    rms, most = off_level(FAST, math.radians(15), 0.5)
    assert rms < 1.0
    assert most < 3.0


def test_at_rest_it_stays_quiet():
    rms, most = off_level(FAST, 0.0, 0.5)
    assert rms < 0.5
    assert most < 1.2


def test_a_slow_adapter_still_levels():
    rms, most = off_level(Ax12Config(), math.radians(15), 0.5, latency_s=0.016)
    assert rms < 2.0
    assert most < 4.0


def test_the_measure_itself():
    assert tilt_of_lidar(0.2, 0.0, 0.0, -0.2) == pytest.approx(0.0, abs=1e-7)
    assert tilt_of_lidar(0.0, 0.3, -0.3, 0.0) == pytest.approx(0.0, abs=1e-7)
    assert tilt_of_lidar(0.2, 0.0, 0.0, 0.0) == pytest.approx(0.2)
    assert tilt_of_lidar(0.0, 0.2, 0.1, 0.0) == pytest.approx(0.3)
