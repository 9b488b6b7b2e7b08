"""A car with a VESC that drives, steers and measures the battery drives its bend, on the virtual clock."""

import math
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

ROBOTS = Path(__file__).resolve().parents[2] / "configs" / "robots"
CAR = """\
include: {robots}/ackermann.yaml
version: 2
geometry: {{ drive_ratio: 12.0 }}
devices:
  drive: null
  steering: null
  compass: null
  {imu}
  actuators:
    driver:
      kind: vesc
      max_motor_rpm: 1000
      battery: {{ cells: 6 }}
      servo: {{ centre: 0.5, per_radian: 0.6, min: 0.1, max: 0.9, dead_time: 0.012, lag: 0.0 }}
{gate}
sim:
  world:
    truck:
      motor: {{ ratio: 12.0, inverted: false, coast_rpm_s: 500.0, drivetrain_lag: 0.03, torque_constant: 0.05 }}
      front_servo: {{ channel: 0, centre_us: 1500.0, us_per_degree: -10.4720, rate: 6.0 }}
      rear_servo: {{ channel: 5 }}
"""


BNO085 = "imu: { driver: { kind: bno085 } }"
NO_ATTITUDE = "gate: { attitude: null }"


def car(folder: Path, imu: str = "", gate: str = NO_ATTITUDE) -> SimulatedTruckConfig:
    file = folder / "car.yaml"
    file.write_text(CAR.format(robots=ROBOTS, imu=imu, gate=gate))
    config, _ = load_config(file, SimulatedTruckConfig)
    return config.model_copy(update={"recorder": None})


@pytest.mark.parametrize(("imu", "gate"), [("", NO_ATTITUDE), (BNO085, "")], ids=["no attitude", "BNO085"])
def test_it_drives_its_bend_without_a_compass(tmp_path: Path, imu: str, gate: str):
    config = car(tmp_path, imu, gate)

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.BATTERY, latest()) as battery:
            async with rig.running():
                lap = await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=40)
                await clock.sleep(0.5)
            assert battery.latest is not None
            assert battery.latest.voltage == pytest.approx(24.0, abs=1.5)
        assert lap.outcome is Reason.GOAL_REACHED
        assert lap.cross_track_rms < 0.03
        truth = rig.truth.array()
        assert not truth[:, 5].any()
        assert math.dist(truth[-1, 1:3], (2.4, 4.15)) < 0.06

    run_virtual(main, start=SECOND)


ESC_CAR = """\
include: {robots}/ackermann.yaml
version: 2
geometry: {{ drive_ratio: 12.0 }}
devices:
  drive: null
  steering: null
  compass: null
  actuators:
    driver:
      kind: maestro_esc
      esc: {{ channel: 2, max_rate: 60.0, deceleration: 400.0, quick_deceleration: 500.0 }}
      unit: {{ dead_time: 0.012, lag: 0.0 }}
gate: {{ attitude: null }}
sim:
  world:
    truck:
      motor: {{ ratio: 12.0, inverted: false, coast_rpm_s: 500.0, drivetrain_lag: 0.03, torque_constant: 0.05 }}
"""


def test_a_car_with_a_speed_controller_without_feedback_drives_its_bend(tmp_path: Path):
    file = tmp_path / "car.yaml"
    file.write_text(ESC_CAR.format(robots=ROBOTS))
    config = load_config(file, SimulatedTruckConfig)[0].model_copy(update={"recorder": None})
    assert any("no sensor measures the motor" in text for text in config.weakened())

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            lap = await drive_lap(LocalOperator(rig.daemon, clock), clock, limit=40)
            await clock.sleep(0.5)
        assert lap.outcome is Reason.GOAL_REACHED
        truth = rig.truth.array()
        assert not truth[:, 5].any()
        assert math.dist(truth[-1, 1:3], (2.4, 4.15)) < 0.1

    run_virtual(main, start=SECOND)


def test_unplugged_in_full_drive_it_stands_by_its_own_watchdog(tmp_path: Path):
    config = car(tmp_path)

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            await clock.sleep(3.0)
            await operator.order(Order.ARM)
            await clock.sleep(4.0)
            assert rig.world.truth(clock.now()).v > 0.05
            rig.robot.ports["actuators"].unplug()
            await clock.sleep(0.3)
            assert rig.world.truth(clock.now()).v < config.gate.standstill
            with rig.bus.subscribe(topics.GATE, latest()) as gate:
                await gate.next()
                assert Reason.DRIVE_STALE in gate.latest.reasons

    run_virtual(main, start=SECOND)
