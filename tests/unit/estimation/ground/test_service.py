"""The ground's service: what compass, scans and slip say about the cells under and before the robot."""

import asyncio
import math

import numpy as np
import pytest

from monstertruck_estimation.ground.config import GroundConfig
from monstertruck_estimation.ground.grid import FILE
from monstertruck_estimation.ground.service import GroundService
from monstertruck_estimation.scan_tilt import ScanAngles
from monstertruck_runtime.clock import run_virtual
from monstertruck_runtime.mailbox import Delivery, Mailbox, latest
from monstertruck_runtime.threads import inline
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.body import Mount
from monstertruck_schemas.health import OdometryHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import VALID_BEAM, Attitude, LaserScan
from monstertruck_schemas.state import GROUND_UNKNOWN, ROUGHNESS_STEP, TILT_STEP, Odometry

QUEUE = Delivery(1024, counted=False)
SPEED, STEP = 0.2, 0.05
MOUNT = Mount(x=0.14, z=0.25)


class Kept(list):
    def next_seq(self) -> int:
        return len(self)

    put = list.append


class Rig:
    """Drives along x for some seconds; what it feels is a function of x."""

    def __init__(self, clock, **options) -> None:
        self.clock, self.out, self.events = clock, Kept(), []
        self.compass, self.beside, self.scan = Mailbox(QUEUE), Mailbox(QUEUE), Mailbox(QUEUE)
        self.pose, self.slip = Mailbox(latest()), Mailbox(latest())
        self.service = GroundService(
            GroundConfig(), clock, footprint=(0.47, 0.34), wheelbase=0.32, mount=MOUNT, compass=self.compass,
            angles=ScanAngles(self.beside, None), pose=self.pose, scan=self.scan, slip=self.slip, out=self.out,
            events=lambda *args, **values: self.events.append(args), offload=inline, **options,
        )  # fmt: skip

    async def drive(
        self,
        seconds,
        pitch=lambda _: 0.0,
        *,
        slipping=False,
        speed=SPEED,
        yaw=0.0,
        fresh=True,
        scanned=None,
        accelerates=0.0,
    ):
        serving = asyncio.create_task(self.service.run(lambda: None))
        x, still = 0.0, speed
        for i in range(round(seconds / STEP)):
            now = self.clock.now()
            speed = still + accelerates * math.sin(1.5 * i * STEP) / 1.5
            x += STEP * speed if i else 0.0
            header = {"stamp": now, "received": now, "seq": i}
            forward = accelerates * math.cos(1.5 * (i - 1) * STEP)
            felt = Attitude(**header, heading=0.0, roll=0.0, pitch=pitch(x) - math.atan2(forward, 9.81))
            self.compass.put(felt)
            self.beside.put(felt)
            if fresh or i == 0:
                self.pose.put(Odometry(
                    **header, frame="map", pose=Pose2D(x=x, y=0.0, yaw=yaw if i % 4 else -yaw),
                    twist=Twist2D(vx=speed, vy=0.0, wz=0.0),
                    pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0, sources=(),
                ))  # fmt: skip
            self.slip.put(OdometryHealth(**header, slipping=slipping, disturbed=False, sources=()))
            if scanned is not None and i % 2 == 0:
                self.scan.put(scanned(header, pitch(x)))
            await self.clock.sleep(STEP)
        serving.cancel()
        await asyncio.wait([serving])
        return self.out[-1] if self.out else None


def driven(seconds, *args, options=None, **kwargs):
    return run_virtual(lambda clock: Rig(clock, **(options or {})).drive(seconds, *args, **kwargs))


def layer(ground, name, x, y=0.0):
    column = math.floor((x - ground.origin.x) / ground.resolution)
    row = math.floor((y - ground.origin.y) / ground.resolution)
    value = int(getattr(ground, name)[row * ground.width + column])
    return None if value == GROUND_UNKNOWN else value * {"tilt": TILT_STEP, "roughness": ROUGHNESS_STEP}[name]


def test_a_slope_is_tilt_and_a_washboard_is_roughness():
    ground = driven(20, lambda x: -0.15 if x < 1.5 else 0.08 * math.sin(x * 40) if x > 2.5 else 0.0)
    assert ground.frame == "map"
    assert layer(ground, "tilt", 0.8) == pytest.approx(0.15, abs=0.01)
    assert layer(ground, "roughness", 0.8) < 0.003
    assert layer(ground, "tilt", 2.2) < 0.05
    assert layer(ground, "roughness", 3.3) > 0.008
    assert layer(ground, "tilt", 0.8, 0.3) is None, "beside the robot nothing was felt"


def test_a_truck_whose_speed_swings_does_not_tilt_level_ground():
    ground = driven(10, accelerates=0.7)  # which looks like 4 degrees to either side
    assert layer(ground, "tilt", 1.0) < 0.03


def test_ground_on_which_wheels_slip_is_rough():
    assert layer(driven(8), "roughness", 0.8) == 0.0
    assert layer(driven(8, slipping=True), "roughness", 0.8) == pytest.approx(0.05)


@pytest.mark.parametrize("how", [{"speed": 0.0}, {"speed": 0.0, "yaw": math.pi}, {"fresh": False}])
def test_nothing_is_learnt_at_rest_or_without_a_fresh_pose(how):
    assert driven(8, lambda _: 0.1, **how) is None


def level_floor(header, pitch):
    """What a lidar pitched nose down over level ground sees of it."""
    angles = np.linspace(-2.0, 2.0, 600)
    fall = np.cos(angles) * math.sin(pitch)
    with np.errstate(divide="ignore"):
        ranges = np.where(fall > 0, MOUNT.z / fall, np.inf)
    ranges[ranges > 5.6] = np.inf
    return LaserScan(
        **header, start_angle=-2.0, end_angle=2.0, time_increment=0.0, scan_time=0.1, range_min=0.02, range_max=5.6,
        ranges=ranges, codes=np.full(600, VALID_BEAM, np.uint8),
    )  # fmt: skip


def test_tilted_scans_show_the_ground_before_the_robot():
    ground = driven(6, lambda x: 0.15 * math.sin(x * 30), scanned=level_floor)
    ahead = [layer(ground, "tilt", x, y) for x in np.arange(1.6, 3.0, 0.1) for y in (-0.3, 0.0, 0.3)]
    seen = [tilt for tilt in ahead if tilt is not None]
    assert len(seen) >= 4
    assert max(seen) < 0.06


def test_it_is_saved_at_the_end_and_begins_with_what_was_saved(tmp_path):
    place = tmp_path / "map"
    driven(8, lambda _: -0.1, options={"save": (place, "run")})
    again = driven(1, options={"load": place})
    assert layer(again, "tilt", 0.8) == pytest.approx(0.1, abs=0.01)


def test_a_damaged_grid_is_an_event_and_the_ground_unknown(tmp_path):
    (tmp_path / FILE).write_bytes(b"PK nothing")

    async def main(clock):
        rig = Rig(clock, load=tmp_path)
        await rig.drive(2)
        return rig.events

    ((reason, _, source, text),) = run_virtual(main)
    assert (reason, source) == (Reason.FILE_DAMAGED, "ground")
    assert text.endswith("; the ground is treated as unknown")


def test_a_folder_that_cannot_be_written_is_an_event(tmp_path):
    (tmp_path / "file").write_text("")

    async def main(clock):
        rig = Rig(clock, save=(tmp_path / "file" / "map", "run"))
        await rig.drive(2)
        return rig.events

    ((reason, _, source, text),) = run_virtual(main)
    assert (reason, source) == (Reason.RECORDING_FAILED, "ground")
    assert "not saved" in text
