"""A truck that is carried elsewhere while it maps: it says that it is lost until a closure joins both parts."""

import math

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck
from tests.daemon.slam_kit import driven, share_beside_walls

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

START = (1.0, 3.95, 0.0)
OUT = ((1.0, 3.95), (5.9, 3.95), (6.85, 4.5), (6.85, 5.6))
"""Along the hall and into a room, from where the truck is carried to ``CARRIED``."""
CARRIED = (8.6, 3.9, math.pi)
AGAIN = ((8.6, 3.9), (3.0, 3.95))
"""Along the hall in the other direction."""


async def pursue(rig: VirtualRig, truck: LocalTruck, corners: tuple[tuple[float, float], ...]) -> None:
    """Steer by the true pose along a polyline to its end."""
    lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(np.array(corners), axis=0).T))))
    stations = np.arange(0.0, lengths[-1], 0.05)
    line = np.stack([np.interp(stations, lengths, column) for column in np.array(corners).T], axis=-1)
    while True:
        truth = rig.world.truth(rig.clock.now())
        nearest = int(np.argmin(np.hypot(*(line - (truth.x, truth.y)).T)))
        if nearest >= len(line) - 3:
            return
        dx, dy = line[min(nearest + 9, len(line) - 1)] - (truth.x, truth.y)
        side = -math.sin(truth.yaw) * dx + math.cos(truth.yaw) * dy
        angle = math.atan(0.32 * side / max(dx * dx + dy * dy, 0.01))
        await truck.drive(0.2, min(max(angle, -0.35), 0.35), min(max(-angle, -0.35), 0.35))
        await rig.clock.sleep(0.1)


@pytest.mark.long
def test_a_truck_that_is_carried_is_lost_until_its_places_are_joined():
    at = []

    async def story(rig: VirtualRig) -> None:
        truck = LocalTruck(rig.daemon, rig.clock)
        await truck.arm()
        await pursue(rig, truck, OUT)
        at.append(rig.clock.now() / SECOND)
        rig.world.carry(rig.clock.now(), CARRIED)
        await pursue(rig, truck, AGAIN)

    place = dict(zip(("x", "y", "yaw"), START, strict=True))
    drive = driven(
        "slam.yaml",
        story,
        topics.MAP,
        path=None,
        odometry={"start": place},
        slam={"map_period": 2.0},
        sim={"world": {"map": "rooms", "start": place}},
    )
    standing = [(message.stamp / SECOND, message.standing) for message in drive.health]
    lost = [stamp for stamp, status in standing if status is LocalisationStatus.LOST]
    joined = next(stamp for stamp, status in standing if stamp > lost[0] and status is not LocalisationStatus.LOST)
    assert at[0] < lost[0] < at[0] + 3.0
    assert all(status is not LocalisationStatus.LOST for stamp, status in standing if stamp > joined)
    assert drive.truth[-1, 0] > joined + 2.0
    reasons = [event.reason for event in drive.events if event.source == "slam"]
    assert reasons.index(Reason.POSE_LOST) < reasons.index(Reason.POSE_FOUND)
    assert "two submaps are joined" in {event.text for event in drive.events if event.reason is Reason.LOOP_CLOSED}
    before = [pose.stamp / SECOND < at[0] for pose in drive.poses]
    off = drive.off()
    assert off[before].max() < 0.08
    assert off[[not b and pose.stamp / SECOND < lost[0] for b, pose in zip(before, drive.poses, strict=True)]].max() > 2
    assert drive.off(joined + 0.5).max() < 0.1
    assert share_beside_walls(drive.said["state/map"][-1], "rooms") < 0.03
