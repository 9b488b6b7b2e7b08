"""The whole daemon reports what goes wrong with the estimation: a corridor, slipping wheels, iron at the compass."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap, save_map
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.health import LocalisationStatus, OdometryHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.config import Iron
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "fusion.yaml"


def corridor(folder: Path) -> Path:
    """22 m long and 1.6 m wide, without a feature."""
    cells = np.full((80, 896), FREE, dtype=np.int8)
    cells[:8], cells[-8:], cells[:, :8], cells[:, -8:] = OCCUPIED, OCCUPIED, OCCUPIED, OCCUPIED
    save_map(WorldMap(cells, 0.025, (-11.2, -1.0)), folder / "corridor.yaml")
    return folder / "corridor.yaml"


def test_a_corridor_shows_in_health_as_degenerate(tmp_path: Path):
    config, _ = load_config(CONFIG, SimulatedTruckConfig)
    world = config.sim.world.model_copy(
        update={"map": str(corridor(tmp_path)), "start": Pose2D(x=0.0, y=0.0, yaw=0.0), "objects": ()}
    )
    config = config.model_copy(
        update={"recorder": None, "map": None, "sim": config.sim.model_copy(update={"world": world})}
    )

    async def main(clock: VirtualClock) -> tuple:
        rig = VirtualRig(config, clock)
        health, events, poses = (
            rig.bus.subscribe(topic, fifo(4096)) for topic in (topics.SLAM, topics.EVENT, topics.POSE)
        )
        async with rig.running():
            await clock.sleep(8.0)
        return health.drain(), events.drain(), poses.drain()

    health, events, poses = run_virtual(main, start=SECOND)
    assert len(health) > 40
    assert np.mean([message.standing is LocalisationStatus.DEGENERATE for message in health[5:]]) > 0.9
    assert health[-1].degeneracy < 0.03
    assert abs(np.sin(health[-1].direction)) < 0.1, "it knows least along the corridor"
    assert Reason.MATCH_DEGENERATE in {event.reason for event in events}
    assert abs(poses[-1].pose.x) < 0.1


@pytest.fixture(scope="module")
def troubled() -> dict:
    """Iron for 2 s, then wheels that turn three times as fast as the truck drives for 1 s, and 4 s without either."""
    config, _ = load_config(CONFIG, SimulatedTruckConfig)
    # The motor reports three times the ordered speed: the gate would stop the truck before the odometry judges.
    gate = config.gate.model_copy(update={"runaway": None})
    config = config.model_copy(update={"recorder": None, "map": None, "consistency": None, "gate": gate})

    async def main(clock: VirtualClock) -> dict:
        rig = VirtualRig(config, clock)
        boxes = {
            topic.name: rig.bus.subscribe(topic, fifo(20_000))
            for topic in (topics.ODOMETRY, topics.FUSION, topics.EVENT)
        }
        operator = LocalOperator(rig.daemon, clock)
        compass, motor = rig.world.compass, rig.world.motors[0]
        at = {}
        async with rig.running():
            await clock.sleep(1.5)
            await operator.arm()
            await clock.sleep(4.0)
            at["iron"], plain = clock.now(), compass._config
            compass._config = plain.model_copy(update={"iron": Iron(hard_x=150.0, hard_y=100.0)})
            await clock.sleep(2.0)
            compass._config = plain
            await clock.sleep(2.0)
            at["slip"], read = clock.now(), motor.reading
            begun = read(clock.now()).turns
            end = clock.now() + SECOND

            def slipping(now: int):
                reading = read(now)
                spun = (read(min(now, end)).turns if now <= end else at["spun"]) - begun
                at["spun"] = begun + spun
                return reading._replace(turns=reading.turns + 2 * spun)

            motor.reading = slipping
            await clock.sleep(5.0)
        return {**{name: box.drain() for name, box in boxes.items()}, **at}

    return run_virtual(main, start=SECOND)


def reported(run: dict, reason: Reason) -> list[float]:
    """Stamps of an event, s."""
    return [event.stamp / SECOND for event in run[topics.EVENT.name] if event.reason is reason]


def sources(run: dict, second: float) -> set[str]:
    """Sensors of the odometry at an instant, s."""
    return set(next(message.sources for message in run["state/odometry"] if message.stamp >= second * SECOND))


def health(run: dict, second: float) -> OdometryHealth:
    """The newest health of the odometry at an instant, s."""
    return [one for one in run[topics.FUSION.name] if one.stamp <= second * SECOND][-1]


def test_iron_near_the_compass_is_reported_and_the_compass_no_source(troubled: dict):
    begin = troubled["iron"] / SECOND
    assert any(begin < second < begin + 0.5 for second in reported(troubled, Reason.HEADING_DISTURBED))
    assert "compass" in sources(troubled, begin)
    assert not health(troubled, begin).disturbed
    assert health(troubled, begin + 1.9).disturbed
    assert "compass" not in sources(troubled, begin + 1.9)


def test_slip_and_its_end_are_reported(troubled: dict):
    begin = troubled["slip"] / SECOND
    assert any(begin < second < begin + 1.0 for second in reported(troubled, Reason.WHEEL_SLIP))
    assert any(begin + 1.0 < second < begin + 4.0 for second in reported(troubled, Reason.WHEEL_GRIP))
    assert [health(troubled, begin + later).slipping for later in (0.0, 1.0, 4.0)] == [False, True, False]
