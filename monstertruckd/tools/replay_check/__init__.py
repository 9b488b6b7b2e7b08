"""Repetition of a recorded run: its sensor data through estimation again, the outputs compared."""

from monstertruckd.tools.replay_check.check import check_log
from monstertruckd.tools.replay_check.recorded import parts_of, run_of
from monstertruckd.tools.replay_check.result import CheckedReplay

__all__ = ["CheckedReplay", "check_log", "parts_of", "run_of"]
