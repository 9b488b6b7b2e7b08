"""Writing the log: MCAP files of everything the bus carries, in a thread of its own."""

from monstertruckd.recorder.config import RecorderConfig
from monstertruckd.recorder.digest import LogDigest
from monstertruckd.recorder.recorder import Recorder

__all__ = ["LogDigest", "Recorder", "RecorderConfig"]
