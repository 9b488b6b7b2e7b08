"""Mapping in the daemon with odometry whose turns have the wrong sign: it is reported, and the pose stays true."""

from dataclasses import replace

import numpy as np
import pytest

from monstertruck_estimation.odometry import DeadReckoning, OdometryEstimate
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import LocalisationStatus, OdometryUse
from monstertruck_schemas.reasons import Reason
from tests.daemon.slam_kit import driven, lap

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


@pytest.mark.long
def test_mirrored_turns_are_reported_and_the_pose_stays_true(monkeypatch: pytest.MonkeyPatch):
    right, first = DeadReckoning.estimate, []

    def mirrored(self: DeadReckoning, now: int) -> OdometryEstimate | None:
        estimate = right(self, now)
        if estimate is None:
            return None
        first.append(estimate.pose)
        x, y, yaw = between(np.array(first[0]), np.array(estimate.pose)).tolist()
        pose, (vx, vy, wz) = compose(np.array(first[0]), np.array((x, -y, -yaw))).tolist(), estimate.twist
        return replace(estimate, pose=tuple(pose), twist=(vx, -vy, -wz))

    monkeypatch.setattr(DeadReckoning, "estimate", mirrored)
    drive = driven("slam.yaml", lap(18))
    turned = drive.truth[np.argmax(np.abs(np.unwrap(drive.truth[:, 3]) - drive.truth[0, 3]) > 0.3), 0]
    dropped = next(e for e in drive.events if e.reason is Reason.ODOMETRY_DROPPED)
    assert dropped.stamp / SECOND < turned + 5.0
    assert drive.health[-1].odometry is OdometryUse.CONTRADICTED
    assert {message.standing for message in drive.health} <= {LocalisationStatus.MAPPING, LocalisationStatus.DEGENERATE}
    assert drive.off(dropped.stamp / SECOND + 1.0).max() < 0.15
