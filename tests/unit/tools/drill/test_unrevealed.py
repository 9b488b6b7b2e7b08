"""The table of families that nothing reveals."""

from pathlib import Path

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_sim.families import families
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.summary import FamilySummary, without_reason
from monstertruckd.tools.drill.unrevealed import UNREVEALED, limit_of
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

ROOT = Path(__file__).resolve().parents[4]


def names():
    async def main(clock):
        config = load_config(ROOT / "configs" / "full.yaml", SimulatedTruckConfig)[0]
        async with VirtualRig(config, clock).running() as rig:
            return [family.name for family in families(rig.robot)]

    return run_virtual(main, start=SECOND)


def summary(family, noticed):
    return FamilySummary(family, 3, noticed, None, None, None, 0, 0)


def test_every_pattern_is_of_a_family_and_no_family_is_in_two_rows():
    found = names()
    for row in UNREVEALED:
        for pattern in row.families:
            assert any(row._replace(families=(pattern,)).holds(name) for name in found), pattern
    assert max(sum(row.holds(name) for row in UNREVEALED) for name in found) == 1


def test_orders_to_move_and_what_guards_the_robot_are_not_among_them():
    for signal in ("target_velocity", "quick_stop", "position_actual", "velocity_averaged"):
        assert limit_of(f"drive {signal} scaled") is None
    assert limit_of("lidar range frozen") is None
    assert limit_of("compass heading scaled") is None


def test_families_without_a_reason_are_listed_with_their_limit_or_by_name():
    tried = ("camera image late", 0), ("camera open lost", 0), ("lidar range noisy", 0), ("lidar range frozen", 2)
    lines = list(without_reason(summary(*each) for each in tried))
    assert lines == [
        f"nothing reveals camera image late, camera open lost: {UNREVEALED[0].why}; limit: {UNREVEALED[0].limit}",
        "no reason within the trial: lidar range noisy",
    ]
