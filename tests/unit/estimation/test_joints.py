"""A stabiliser's joints in the tree of frames."""

import math

import pytest

from monstertruck_estimation.transforms import TransformService, compose, invert, mount
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.sensor import StabiliserFeedback, StabiliserJoint, TorqueState
from monstertruck_schemas.state import Odometry, Transforms
from tests.unit.estimation.kit import looked_up

CENTRE = mount("stabiliser", (0.1, 0.0, 0.2))
LIDAR = compose(invert(CENTRE), mount("lidar", (0.14, 0.0, 0.25)))
HOLDING = StabiliserJoint(torque=TorqueState.HOLDING)


class Nowhere:
    def next_seq(self) -> int:
        return 0

    def put(self, message: Transforms) -> None:
        pass


def feedback(pitch: float | None, roll: float | None) -> StabiliserFeedback:
    return StabiliserFeedback(
        stamp=5, received=5, seq=0, pitch=pitch, roll=roll, pitch_joint=HOLDING, roll_joint=HOLDING
    )


def test_the_lidar_turns_with_the_joints_about_their_centre():
    async def main(clock: VirtualClock) -> None:
        joints: Mailbox[StabiliserFeedback] = Mailbox(latest())
        odometry: Mailbox[Odometry] = Mailbox(latest())
        service = TransformService([LIDAR], clock, odometry, Nowhere(), joints=(CENTRE, joints))
        assert looked_up(service, "base", "lidar").translation == pytest.approx((0.14, 0.0, 0.25))
        joints.put(feedback(math.pi / 2, 0.0))  # nose down: what was above is in front now
        turned = looked_up(service, "base", "lidar")
        assert turned.translation == pytest.approx((0.15, 0.0, 0.16))
        assert looked_up(service, "base", "stabiliser").stamp == 5
        joints.put(feedback(0.3, -0.2))
        rotation = looked_up(service, "base", "stabiliser").rotation
        joints.put(feedback(None, 0.0))  # unknown: what was known stays, with its stamp
        assert looked_up(service, "base", "stabiliser").rotation == rotation

    run_virtual(main)
