"""``simulate``: what keeps it from serving is one sentence with a reason of its own."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import NotPermittedError
from monstertruckd.tools.simulation import simulate
from monstertruckd.tools.simulation.config import load_simulated

ROOT = Path(__file__).resolve().parents[3]


async def test_a_port_that_this_user_may_not_make_is_refused_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    @contextmanager
    def forbidden(*links: Path) -> Iterator[None]:
        raise PermissionError(13, "Permission denied", str(links[0]))
        yield

    port = tmp_path / "lidar"
    config = tmp_path / "truck.yaml"
    config.write_text(
        f"include: {ROOT}/configs/emulated.yaml\nversion: 2\ndevices: {{ lidar: {{ port: {{ path: {port} }} }} }}\n"
    )
    monkeypatch.setattr(simulate, "reserved", forbidden)
    with pytest.raises(NotPermittedError, match=rf"^{port}: this user may not make a port there$"):
        await simulate.serve(WallClock(), load_simulated(config))
