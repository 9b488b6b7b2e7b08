"""Localisation off board: who may correct the pose, how it follows, and what happens when corrections end."""

import asyncio
import math
from typing import Any

import numpy as np
import pytest

from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_estimation.slam.outside import OutsideLocalisation
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import LocalisationRequest, Role
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruckd.bus.local import Bus


class OutsideBench:
    """The service, a gate with a nonce, and a robot that moves 0.1 m/s along x of odom."""

    def __init__(self, clock):
        self.clock, self.bus = clock, Bus(clock)
        subscribe, publisher = self.bus.subscribe, self.bus.publisher
        self.poses, self.health = subscribe(t.POSE, latest()), subscribe(t.SLAM, latest())
        self.events = subscribe(t.EVENT, fifo(1000))
        self.gate, self.out = publisher(t.GATE, t.Writer.GATE), publisher(t.ODOMETRY, t.Writer.ESTIMATION)
        self.service = OutsideLocalisation(
            SlamConfig(mode="ros2"),
            clock,
            requests=subscribe(t.REQ_LOCALISATION, fifo(16)),
            gate=subscribe(t.GATE, latest()),
            odometry=subscribe(t.ODOMETRY, fifo(256)),
            pose=publisher(t.POSE, t.Writer.ESTIMATION),
            health=publisher(t.SLAM, t.Writer.ESTIMATION),
            events=self.bus.event_sink(),
            max_age=0.5,
        )
        self.seq, self.x = 0, 0.0

    async def drive(self, seconds):
        for _ in range(round(seconds * 50)):
            await self.clock.sleep(0.02)
            now = self.clock.now()
            self.x += 0.002
            self.gate.put(GateState(stamp=now, received=now, seq=0, mode=GateMode.DRIVING, nonce="n1", speed_limit=0.2))
            self.out.put(
                Odometry(
                    stamp=now, received=now, seq=self.out.next_seq(), frame="odom", child="base",
                    pose=Pose2D(x=self.x, y=0.0, yaw=0.0), twist=Twist2D(vx=0.1, vy=0.0, wz=0.0),
                    pose_covariance=np.diag((1e-4 * self.x, 1e-4 * self.x, 0.0)).ravel(),
                    twist_covariance=np.zeros(9), age=0.0, sources=("drive",),
                )
            )  # fmt: skip
        await self.clock.sleep(0.001)  # in which the service takes the last one

    async def send(self, *correction, **more: Any):
        now = self.clock.now()
        self.seq += 1
        fields = {"seq": self.seq, "source": "ros2:amcl", "role": Role.STATION, "nonce": "n1", "gate_stamp": now}
        x, y, yaw = correction
        request = LocalisationRequest(
            stamp=now, received=now, **({"lease": 1.0} | fields | more), correction=Pose2D(x=x, y=y, yaw=yaw)
        )
        self.bus.inject(t.REQ_LOCALISATION, request)
        await self.clock.sleep(0.001)
        return [event.reason for event in self.events.drain()]


def on_outside_bench(scenario):
    async def main(clock):
        bench = OutsideBench(clock)
        running = asyncio.create_task(bench.service.run(lambda: None))
        await bench.drive(1.0)
        try:
            await scenario(bench)
            assert not running.done()
        finally:
            running.cancel()
            await asyncio.wait([running])

    run_virtual(main)


def test_the_pose_is_odometry_in_the_corrected_frame():
    async def scenario(bench):
        assert bench.health.latest.standing is LocalisationStatus.SEARCHING
        assert await bench.send(1.0, 2.0, math.pi / 2) == [Reason.POSE_FOUND]
        await bench.drive(0.2)
        pose = bench.poses.latest
        assert (pose.frame, pose.sources) == ("map", ("drive",))
        assert (pose.pose.x, pose.pose.y) == (pytest.approx(1.0), pytest.approx(2.0 + bench.x))
        assert pose.pose.yaw == pytest.approx(math.pi / 2)
        (row,) = bench.service.frames()
        assert (row.parent, row.child, row.translation[:2]) == ("map", "odom", (1.0, 2.0))
        assert bench.health.latest.standing is LocalisationStatus.LOCALISED
        # a later correction is approached, so that the pose does not jump
        assert await bench.send(1.2, 2.0, math.pi / 2) == []
        await bench.drive(0.1)
        assert 1.0 < bench.poses.latest.pose.x < 1.1
        await bench.drive(0.8)
        assert bench.poses.latest.pose.x == pytest.approx(1.2)

    on_outside_bench(scenario)


def test_a_pose_without_corrections_is_lost_and_less_certain_until_they_come_again():
    async def scenario(bench):
        await bench.send(1.0, 0.0, 0.0)
        await bench.drive(0.9)
        known = bench.poses.latest.position_deviation
        assert bench.health.latest.standing is LocalisationStatus.LOCALISED
        await bench.drive(5.0)
        assert bench.health.latest.standing is LocalisationStatus.LOST
        assert [event.reason for event in bench.events.drain()] == [Reason.POSE_LOST]
        assert bench.poses.latest.pose.x == pytest.approx(1.0 + bench.x)
        assert bench.poses.latest.position_deviation > known
        assert await bench.send(1.0, 0.0, 0.0) == [Reason.POSE_FOUND]

    on_outside_bench(scenario)


def test_a_correction_needs_what_a_request_to_drive_needs():
    async def scenario(bench):
        refusals = {
            Reason.BAD_NONCE: {"nonce": "n0"},
            Reason.LEASE_EXPIRED: {"gate_stamp": bench.clock.now() - SECOND},
            Reason.BAD_ROLE: {"role": Role.TRACKER},
        }
        for reason, fields in refusals.items():
            assert await bench.send(5.0, 5.0, 0.0, **fields) == [reason]
        assert await bench.send(5.0, 5.0, 2e4) == [Reason.BAD_INPUT]
        await bench.drive(0.2)
        assert bench.health.latest.standing is LocalisationStatus.SEARCHING
        assert await bench.send(1.0, 0.0, 0.0, seq=100) == [Reason.POSE_FOUND]
        assert await bench.send(5.0, 5.0, 0.0, seq=100) == [Reason.BAD_SEQUENCE]
        await bench.drive(0.1)
        assert bench.poses.latest.pose.y == 0.0

    on_outside_bench(scenario)


def test_while_one_client_localises_another_is_refused_once_a_second():
    async def scenario(bench):
        await bench.send(1.0, 0.0, 0.0)
        refused = [await bench.send(5.0, 5.0, 0.0, source="ros2:other") for _ in range(5)]
        assert refused == [[Reason.BUSY], [], [], [], []]
        await bench.drive(1.1)
        assert await bench.send(5.0, 5.0, 0.0, source="ros2:other") == [Reason.POSE_LOST, Reason.POSE_FOUND]

    on_outside_bench(scenario)
