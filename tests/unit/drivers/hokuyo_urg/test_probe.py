"""The probe tells who is there, in either dialect, and over a real tty."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.tty import SerialPort
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual, run_wall
from monstertruck_runtime.errors import DeviceTimeoutError
from tests.unit.drivers.hokuyo_urg.rig import Rig, bench


@pytest.mark.parametrize("state", ["scip1", "scip2", "streaming", "time_adjust"])
def test_probe(state: str):
    async def main(clock: VirtualClock) -> tuple[dict[str, object], list[str]]:
        async with bench(clock, state=state) as rig:
            found = await DEVICES["hokuyo_urg"].identify(rig.port, clock)
            return found, list(rig.emulator.received)

    found, received = run_virtual(main)
    reported = json.loads(json.dumps(found))
    assert reported["device"] == DEVICES["hokuyo_urg"].doc
    assert reported["dialect"] == "SCIP 2.0"
    assert reported["identity"]["serial"] == "H0706400"
    assert reported["parameters"]["last_step"] == 725
    assert reported["state"]["status"] == "Sensor works well."
    assert reported["scan"]["beams"] == 682
    assert reported["scan"]["valid"] == 662
    assert reported["scan"]["error_codes"] == {str(code): 1 for code in range(20)}
    assert received[-1] == "QT"


def test_probe_of_an_old_unit():
    async def main(clock: VirtualClock) -> tuple[dict[str, object], list[str]]:
        async with bench(clock, firmware="2.2.5") as rig:
            return await DEVICES["hokuyo_urg"].identify(rig.port, clock), list(rig.emulator.received)

    found, received = run_virtual(main)
    reported = json.loads(json.dumps(found))
    assert reported["dialect"] == "SCIP 1.1"
    assert reported["state"] is None
    assert reported["scan"]["counter_ms"] is None
    assert received[-1] == "L0"


def test_probe_where_nothing_is_seen():
    class Blind:
        def scan(self, time_ns: int) -> np.ndarray:
            return np.ones(769, np.int32)

    async def main(clock: VirtualClock) -> dict[str, object]:
        async with bench(clock, Blind()) as rig:
            return await DEVICES["hokuyo_urg"].identify(rig.port, clock)

    scan = json.loads(json.dumps(run_virtual(main)))["scan"]
    assert (scan["valid"], scan["nearest_m"], scan["farthest_m"]) == (0, None, None)


def test_probe_of_silence():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig:
            rig.port.device.faults.deaf = True
            await DEVICES["hokuyo_urg"].identify(rig.port, clock)

    with pytest.raises(DeviceTimeoutError):
        run_virtual(main)


def test_probe_then_drive_over_a_real_pty(tmp_path: Path):
    async def main(clock: WallClock) -> Rig:
        port = PtyPort(tmp_path / "lidar")
        async with bench(clock, port=port) as rig:
            rig.driver._port = SerialPort(tmp_path / "lidar")
            found = await DEVICES["hokuyo_urg"].identify(rig.driver._port, clock)
            assert found["dialect"] == "SCIP 2.0"
            async with rig.driving(), asyncio.timeout(5):
                await rig.out.total(3)
            return rig

    rig = run_wall(main)
    assert rig.driver.dropped == 0
    assert list(rig.emulator.received)[-1] == "QT"
