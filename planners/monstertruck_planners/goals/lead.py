"""What the tracker is led along on the way to a goal: paths, their early ends, and standing still without disarming."""

from typing import Any, Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.goals.escape import placed
from monstertruck_planners.goals.exchange import PlanAnswer
from monstertruck_planners.goals.lookout import cut
from monstertruck_planners.goals.parts import Followed, Inputs, Outputs, pose_of
from monstertruck_runtime.clock import Clock
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role

SOURCE: Final = "goals"
AT_REST: Final = 0.01
"""Speed of a truck at rest, m/s."""
LEASE: Final = 0.25
"""Lease of the request to stand still, s."""
STUB: Final = 0.01
"""Length of a path that leads nowhere, m."""


class Lead:
    """Publishes paths and remembers the one that is followed.

    Args:
        clock: time.
        inputs: topics read.
        outputs: topics written.
        deceleration: with which the tracker brakes, m/s^2.
    """

    def __init__(self, clock: Clock, inputs: Inputs, outputs: Outputs, deceleration: float) -> None:
        self._clock, self._in, self._out, self._deceleration = clock, inputs, outputs, deceleration
        self._paths = 0
        self.followed: Followed | None = None

    def follow(self, answer: PlanAnswer, name: str, before: float = 0.0) -> None:
        """Have a path driven.

        Args:
            answer: the path.
            name: of it; a number is added.
            before: metres driven already on the way that it is part of.
        """
        assert answer.poses is not None
        assert answer.directions is not None
        steering = answer.steering if len(answer.steering) == len(answer.poses) else ()
        self._publish(answer.poses, answer.directions, steering, name, before)

    def brake(self, name: str) -> None:
        """Let what is followed end as soon as the tracker can brake; at rest, here."""
        odometry, followed = self._in.pose.latest, self.followed
        if odometry is None or followed is None:
            return
        speed, report = abs(odometry.twist.vx), followed.told(self._in.tracker.latest)
        driven = followed.before + followed.along(report)
        if speed > AT_REST and report is not None:
            way = speed * speed / (2 * self._deceleration) + STUB
            count = cut(followed.poses, followed.travelled, report.along, way)
            steering = followed.message.steering[:count]
            self._publish(followed.poses[:count], followed.message.directions[:count], steering, name, driven)
        else:
            ahead = np.array([[0.0, 0.0, 0.0], [STUB, 0.0, 0.0]])
            self._publish(placed(ahead, pose_of(odometry)), np.ones(2), (), name, driven)

    def halt(self, name: str) -> None:
        """Brake, and follow nothing."""
        self.brake(name)
        self.followed = None

    @property
    def driving(self) -> bool:
        """Whether the tracker is on its way along what is followed."""
        report = None if self.followed is None else self.followed.told(self._in.tracker.latest)
        return report is not None and report.outcome is Reason.DRIVING

    @property
    def displaced(self) -> bool:
        """Whether somebody else's path is followed now."""
        return self.followed is not None and self._in.path.latest is not self.followed.message

    def _publish(self, poses: Array, directions: Array, steering: tuple[Any, ...], name: str, before: float) -> None:
        now, odometry = self._clock.now(), self._in.pose.latest
        assert odometry is not None
        self._paths += 1
        message = Path(
            stamp=now,
            received=now,
            seq=self._out.path.next_seq(),
            frame=odometry.frame,
            poses=np.ascontiguousarray(poses).ravel(),
            directions=np.array(directions),
            steering=steering,
            name=f"{name}.{self._paths}",
        )
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        self.followed = Followed(message, poses, np.concatenate(([0.0], np.cumsum(steps))), before)
        self._out.path.put(message)

    def stand_still(self) -> None:
        """Ask the gate for standstill, so that the truck stays armed while nothing is driven."""
        gate, now = self._in.gate.latest, self._clock.now()
        if self.driving or gate is None or not gate.mode.active:
            return
        self._out.planner_request.put(
            DriveRequest(
                stamp=now,
                received=now,
                seq=self._out.planner_request.next_seq(),
                source=SOURCE,
                role=Role.TRACKER,
                lease=LEASE,
                nonce=gate.nonce,
                gate_stamp=gate.stamp,
                speed=0.0,
                front=0.0,
                rear=0.0,
            )
        )
