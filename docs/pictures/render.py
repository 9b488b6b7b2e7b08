"""Draws the moving pictures of the README: a lap, and a goal with a post put into the way.

    python docs/pictures/render.py

Both are drives of the whole daemon on the virtual clock, drawn by ``monstertruckd log animate``.
"""

import asyncio
from pathlib import Path
from tempfile import TemporaryDirectory

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.plan import GoalPhase
from monstertruck_sim.world.obstacles import Disc
from monstertruckd.config.load import load_config
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.demo.runs import run_fast_demo
from monstertruckd.tools.logs.animation import animate
from monstertruckd.tools.shipped import shipped
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

PICTURES = Path(__file__).resolve().parent
GOAL = {"x": 6.0, "y": 3.9, "yaw": 0.0}
POST_AFTER = 5.0
"""Seconds of driving, then a post of this radius (m) stands this far ahead and aside (m)."""
POST_RADIUS, POST_AHEAD, POST_ASIDE = 0.12, 1.3, 0.05
LIMIT = 90.0


def lap(folder: Path) -> None:
    """The lap of the demo."""
    run_fast_demo(shipped("configs/demo.yaml"), folder, None)


def goal(folder: Path) -> None:
    """A goal beyond a post that is not in the map."""
    config = load_config(shipped("configs/goals.yaml"), SimulatedTruckConfig)[0]
    overlay = {
        "recorder": {"directory": str(folder / "logs")},
        "placement": {"planner": "loop", "local_planner": "loop"},
    }

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(with_overlay(config, overlay), clock)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            goals = rig.bus.subscribe(topics.GOAL, latest())
            await clock.sleep(3.0)
            await operator.call("goal", {**await operator.header(), "frame": "map", "goal": GOAL})
            await operator.arm()
            await clock.sleep(POST_AFTER)
            truth = rig.world.truth(clock.now())
            rig.world.add(clock.now(), Disc(truth.x + POST_AHEAD, truth.y + POST_ASIDE, POST_RADIUS))
            async with asyncio.timeout(LIMIT):
                while (await goals.next()).phase is not GoalPhase.IDLE:
                    pass
            await clock.sleep(1.0)

    run_virtual(main, start=SECOND)


def main() -> None:
    """Draw both."""
    for name, drive, speed in (("lap", lap, 8.0), ("goal", goal, 4.0)):
        with TemporaryDirectory(prefix="pictures-") as folder:
            drive(Path(folder))
            (log,) = sorted((Path(folder) / "logs").glob("*.mcap"))
            print(name, animate(open_log(log), PICTURES / f"{name}.gif", speed=speed, width=560))


if __name__ == "__main__":
    main()
