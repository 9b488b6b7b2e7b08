"""Writing the log: MCAP files of everything the bus carries, in a thread of its own; the black box of every trip."""

from monstertruckd.recorder.black_box import BlackBox
from monstertruckd.recorder.boxes import Box, black_boxes
from monstertruckd.recorder.config import BlackBoxConfig, RecorderConfig
from monstertruckd.recorder.digest import LogDigest
from monstertruckd.recorder.recorder import Recorder

__all__ = [
    "BlackBox",
    "BlackBoxConfig",
    "Box",
    "LogDigest",
    "Recorder",
    "RecorderConfig",
    "black_boxes",
]
