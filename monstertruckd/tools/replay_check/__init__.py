"""What a robot would have made of a recorded run: its sensors once more through estimation, the outputs compared."""

from monstertruckd.tools.replay_check.check import check_log
from monstertruckd.tools.replay_check.recorded import parts_of, run_of
from monstertruckd.tools.replay_check.result import CheckedReplay

__all__ = ["CheckedReplay", "check_log", "parts_of", "run_of"]
