import asyncio

import pytest
from pydantic import TypeAdapter, ValidationError

from monstertruck_estimation.catalog import AnyOdometry
from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_estimation.fusion.service import FusionService
from monstertruck_estimation.fusion.slip import SlipChange
from monstertruck_estimation.inertial import InertialInput
from monstertruck_estimation.odometry import OdometryConfig
from monstertruck_runtime.clock import run_virtual
from monstertruck_schemas.reasons import Reason
from tests.unit.estimation.fusion.kit import FIELD, Rig, attitude

READ = TypeAdapter(AnyOdometry)


class Outbox(list):
    def next_seq(self):
        return len(self)

    put = list.append


class Scans:
    def __init__(self, motions):
        self.motions = motions

    def drain(self):
        motions, self.motions = self.motions, []
        return motions


def served(rig, scans=None, seconds=0.1, health=None):
    """What a service over the rig's fusion tells in a tenth of a second."""
    events, odometry = [], Outbox()

    def tell(reason, severity, source, text="", **_):
        events.append((reason, text))

    async def main(clock):
        service = FusionService(
            rig.fusion,
            clock,
            drives=[],
            steering=None,
            compass=None,
            scans=scans,
            odometry=odometry,
            pose=None,
            health=Outbox() if health is None else health,
            events=tell,
            imu=None if rig.inertial is None else InertialInput(rig.inertial, Scans([]), tell, "odometry"),
        )
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(seconds)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main, start=rig.now)
    return events, odometry


def test_slip_and_a_disturbed_compass_are_events():
    rig = Rig().drive(0.3, 0.0, 0.0, 4.0)
    rig.field, rig.magnet = 2 * FIELD, 0.5
    rig.drive(0.3, 0.0, 0.0, 0.5)
    rig.fusion._changes.extend((SlipChange(True, 0, "apart"), SlipChange(False, 0, "together")))
    events, odometry = served(rig)
    assert [reason for reason, _ in events] == [Reason.WHEEL_SLIP, Reason.WHEEL_GRIP, Reason.HEADING_DISTURBED]
    assert events[0][1] == "apart"
    assert "lidar" in odometry[-1].sources
    assert odometry[-1].frame == "odom"


def test_health_is_reported_once_a_second_and_at_once_when_it_changes():
    rig = Rig().drive(0.3, 0.0, 0.0, 2.0)
    health = Outbox()
    served(rig, seconds=2.5, health=health)
    assert [(one.slipping, one.disturbed) for one in health] == [(False, False)] * 3
    assert set(health[0].sources) == {"drive", "steering", "compass", "tilt", "lidar"}
    assert health[-1].sources == ()
    rig.fusion.observe_attitude(attitude(rig.now + 1, 2.0, heading_disturbed=True))
    rig.fusion.observe_attitude(attitude(rig.now, 2.0))
    served(rig, health=health)
    assert health[3].disturbed
    assert health[3].left_out == 1
    assert health[3].north is not None


def test_an_imu_with_the_wrong_sign_is_an_event_and_no_source():
    rig = Rig(("wheels", "imu"))
    rig.gyro = -1.0
    rig.drive(0.0, 0.0, 0.0, 1.0).drive(0.3, 0.2, -0.2, 3.0)
    health = Outbox()
    events, odometry = served(rig, health=health)
    assert [reason for reason, _ in events] == [Reason.IMU_DISAGREES]
    assert "imu" not in odometry[-1].sources
    assert "imu" not in health[-1].sources
    rig.gyro = 1.0
    rig.drive(0.3, 0.2, -0.2, 3.0)
    events, odometry = served(rig)
    assert [reason for reason, _ in events] == [Reason.IMU_DISAGREES, Reason.IMU_AGREES] or not events
    assert "imu" in odometry[-1].sources


def test_the_motion_between_scans_is_taken_from_the_bus():
    rig = Rig().drive(0.3, 0.0, 0.0, 2.0)
    rig.delay = 1000
    rig.drive(0.3, 0.0, 0.0, 0.5)
    before = rig.fusion.state.used["lidar"]
    served(rig, Scans(list(rig.waiting)))
    assert rig.fusion.state.used["lidar"] > before


def test_the_section_is_dead_reckoning_unless_it_says_fusion():
    assert isinstance(READ.validate_python({}), OdometryConfig)
    assert isinstance(READ.validate_python({"kind": "fusion", "compass": None}), FusionConfig)


@pytest.mark.parametrize(
    "section", [{"kind": "guess"}, {"kind": "fusion", "slipp": 1}, {"kind": "fusion", "settle": 0}]
)
def test_what_a_section_cannot_say_is_refused(section):
    with pytest.raises(ValidationError):
        READ.validate_python(section)
