"""What a robot would have made of a recorded run: its sensors once more through estimation, the outputs compared."""

from monstertruckd.tools.replay_check.check import check_log
from monstertruckd.tools.replay_check.result import Check
from monstertruckd.tools.replay_check.run_log import parts_of

__all__ = ["Check", "check_log", "parts_of"]
