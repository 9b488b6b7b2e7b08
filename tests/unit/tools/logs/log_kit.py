"""Logs written message by message, and the messages for them."""

import numpy as np

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.state import ClockOffset, GateMode, GateState, Odometry
from monstertruckd.recorder.log_file import LogEntry, LogFile

MAY_2026 = 1_777_600_000 * SECOND
"""Offset of a log whose daemon time began with the boot: its first second is 2026-05-01 01:46:41 UTC."""


class Writer:
    """A log written message by message, counting sequences as the recorder does."""

    def __init__(self, file, metadata=None, **attachments):
        self.log = LogFile(file, "lz4", 1 << 16, attachments, {"real_offset_ns": "5"} | (metadata or {}), SECOND)
        self.sequences = {}

    def put(self, topic, message, skip=0):
        sequence = self.sequences.get(topic.name, 0) + skip
        self.sequences[topic.name] = sequence + 1
        self.log.add(LogEntry(topic, message.received, message.stamp, sequence, wire.encode(topic, message)))


def odometry(now, seq):
    return Odometry(
        stamp=now,
        received=now,
        seq=seq,
        frame="odom",
        pose=Pose2D(x=0.1 * seq, y=0.0, yaw=0.0),
        twist=Twist2D(vx=1.0, vy=0.0, wz=0.0),
        pose_covariance=np.arange(9.0),
        twist_covariance=np.zeros(9),
        age=0.0,
    )


def gate(now, seq, mode=GateMode.DRIVING):
    return GateState(stamp=now, received=now, seq=seq, mode=mode, nonce="n", speed_limit=1.0, holder="tracker")


def clock(now, seq=0, offset=MAY_2026):
    return ClockOffset(stamp=now, received=now, seq=seq, offset=offset)
