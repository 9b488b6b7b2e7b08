"""The examples, each as its user runs it, before an emulated truck."""

import asyncio
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.wall_kit import ROOT, kept_armed, planner_ready, robot
from tests.notebooks import run

pytestmark = [pytest.mark.wall, pytest.mark.timeout(400)]


async def example(folder: Path, name: str, *arguments: str) -> str:
    """Run one in ``folder``; what it printed."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, str(ROOT / "docs" / "examples" / f"{name}.py"), *arguments, cwd=folder,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    output, _ = await process.communicate()
    assert process.returncode == 0, output.decode()
    return output.decode()


async def armed(name: str, folder: Path, *arguments: str) -> str:
    """Run one that arms the truck, again where a busy computer itself is why that is refused."""
    for _ in range(20):
        try:
            return await example(folder, name, *arguments)
        except AssertionError as error:
            if "arm refused" not in str(error):
                raise
    raise AssertionError("the truck could not be armed")


@pytest.mark.long
async def test_examples_plot_save_drive_to_a_goal_and_along_a_path_of_their_own(tmp_path: Path):
    async with robot(tmp_path, base=ROOT / "configs/goals.yaml") as made:
        await made.start_simulator()
        await made.start_daemon()
        async with made.client() as client:
            await example(tmp_path, "battery", made.endpoint, "1")
            assert (tmp_path / "battery.png").stat().st_size > 5000
            assert "5 scans of" in await example(tmp_path, "scans", made.endpoint, "5")
            assert np.load(tmp_path / "scans.npy").shape[0] == 5
            await planner_ready(client)
            async with kept_armed(client):
                assert " m in " in await armed("route", tmp_path, made.endpoint, "1.9,3.95,0", "1.4,3.95")
                assert "off the path" in await armed("planner", tmp_path, made.endpoint, "0.7", "0.03")
            (printed,) = await asyncio.to_thread(run, "drive", ENDPOINT=made.endpoint)
            assert printed.startswith("goal_reached")
        truth = await made.truth()
        assert np.hypot(*(truth[-1, 1:3] - (1.9, 3.95))) < 0.35
