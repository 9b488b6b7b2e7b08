"""A circle and passes to and fro through the whole daemon, its log, and their analysis, on the virtual clock."""

import asyncio
import json
import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruckd.config.load import load_config
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from monstertruckd.tools.study import runs
from monstertruckd.tools.study.log import read_runs

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

STAND = Path(__file__).resolve().parents[2] / "configs" / "robots" / "skid_stand.yaml"
HALF = 0.07
TRUTH = {
    "body": {
        "kind": "skid_steer",
        "motors": "wheels",
        "icr_left": HALF,
        "icr_right": -HALF,
        "gain_left": 1.1,
        "gain_right": 1.1,
    },
    "skid": {"reversal_turn": 0.02, "drift_x": 3e-4, "drift_y": -2e-4},
}


def stand(folder: Path) -> SimulatedTruckConfig:
    config, _ = load_config(STAND, SimulatedTruckConfig)
    return with_overlay(
        config, {"recorder": {"directory": str(folder)}, "blackbox": None, "sim": {"world": {"truck": TRUTH}}}
    )


@pytest.mark.long
def test_a_circle_and_a_line_are_found_in_the_log(tmp_path: Path):
    config = stand(tmp_path)

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            await clock.sleep(2.0)
            await runs.drive(operator, clock, config, runs.CircleRun(ratio=3.0, laps=1.5).plan(config))
            rig.world.carry(clock.now(), (-0.2, 0.0, 0.0))
            await clock.sleep(4.0)
            await runs.drive(operator, clock, config, runs.StraightRun(length=0.3, passes=3).plan(config))

    run_virtual(main, start=SECOND)
    (log,) = tmp_path.rglob("*.mcap")
    result = CliRunner().invoke(app, ["study", "analyse", str(log), "--out", str(tmp_path / "figures"), "--json"])
    assert result.exit_code == 0, result.output
    values = json.loads(result.stdout)
    (circle,), (line,) = values["circles"], values["lines"]
    assert circle["radius"] == pytest.approx(HALF * 2, rel=0.01)
    assert circle["speed"] == pytest.approx(1.1 * 0.021 * 1.57 * 2 / 3, rel=0.01)
    assert circle["drift"] == pytest.approx((3e-4, -2e-4), abs=4e-5)
    assert circle["published"]["radius"] == 0.155
    assert line["passes"] == 3
    assert line["speed"] == pytest.approx(1.1 * 0.021 * 1.57, rel=0.02)
    assert math.degrees(line["reversal_turn"]) == pytest.approx(math.degrees(0.02), abs=0.6)
    drawn = {path.name for path in (tmp_path / "figures").iterdir()}
    assert drawn == {f"figure_{number:02d}.png" for number in (7, 9, 11, 14, 15)}
    table = CliRunner().invoke(app, ["study", "analyse", str(log)])
    assert "15.69 %" in table.stdout
    assert "47.60 %" in table.stdout


def test_a_loss_of_the_controller_stops_all_wheels_and_ends_the_run(tmp_path: Path):
    config = stand(tmp_path).model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            await clock.sleep(2.0)

            async def unplug() -> None:
                await clock.sleep(5.0)
                rig.ports["wheels"].unplug()

            task = asyncio.create_task(unplug())
            with pytest.raises(RequestRefusedError, match="stopped during the run"):
                await runs.drive(operator, clock, config, runs.CircleRun(laps=2.0).plan(config))
            await task
            await clock.sleep(0.5)
            assert abs(rig.truth.array()[-1, 4]) < 1e-6
            rig.ports["wheels"].plug()
            await clock.sleep(2.0)
            await runs.drive(operator, clock, config, [runs.Stretch(1.0, 1.0, 2.0)])
            assert rig.truth.array()[-1, 1] > 0.1

    run_virtual(main, start=SECOND)


def test_a_log_without_a_run_and_too_fast_a_run_are_refused(tmp_path: Path):
    golden = Path(__file__).resolve().parents[1] / "data" / "golden" / "0.1.0" / "run.mcap"
    with pytest.raises(InputError, match="no client drove by shaft speeds"):
        read_runs(golden)
    config = stand(tmp_path).model_copy(update={"recorder": None})

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            await runs.drive(operator, clock, config, [runs.Stretch(9.0, 9.0, 1.0)])

    with pytest.raises(InputError, match=r"at most gate\.speed"):
        run_virtual(main, start=SECOND)
