"""Replay of a recorded run: estimation from its sensor data is recomputed, and the outputs are compared."""

from monstertruckd.tools.replay_check.check import check_log
from monstertruckd.tools.replay_check.recorded import parts_of, run_of
from monstertruckd.tools.replay_check.result import CheckedReplay

__all__ = ["CheckedReplay", "check_log", "parts_of", "run_of"]
