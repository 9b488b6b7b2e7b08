"""A client that is not ours, pyvesc-fix (a fork of PyVESC, CC BY 4.0), at the emulated VESC, over a pty.

Its package names itself pyvesc in its own imports, so it is loaded under that name.
"""

import asyncio
import contextlib
import importlib.util
import sys
import warnings

import pytest

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.vesc.emulator import VescEmulator
from monstertruck_runtime.clock import WallClock

pytestmark = pytest.mark.wall


@pytest.fixture
def pyvesc():
    found = importlib.util.find_spec("pyvesc_fix")
    spec = importlib.util.spec_from_file_location(
        "pyvesc", found.origin, submodule_search_locations=[*found.submodule_search_locations]
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules["pyvesc"] = module
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it compares texts by identity
        spec.loader.exec_module(module)
    yield module
    for name in [name for name in sys.modules if name.partition(".")[0] == "pyvesc"]:
        del sys.modules[name]


async def test_it_runs_the_motor_steers_and_reads_the_values(tmp_path, pyvesc):
    port, rotor = PtyPort(tmp_path / "vesc"), FreeMotor()
    emulator = VescEmulator(WallClock(), (rotor,))
    running = asyncio.create_task(emulator.run(port.device))
    await asyncio.sleep(0)
    port.plug()

    def drive():
        client = pyvesc.VESC(port.name, start_heartbeat=False)
        with client.serial_port:
            version = client.get_firmware_version()
            client.set_servo(0.25)
            client.set_rpm(3000)
            reached = client.get_measurements()
            for _ in range(100):
                reached = client.get_measurements()
                if reached.rpm == 3000:
                    break
            client.set_current(0)
            return version, reached

    try:
        async with asyncio.timeout(20):
            version, values = await asyncio.to_thread(drive)
            while rotor.reading(WallClock().now()).rpm:
                await asyncio.sleep(0.01)
    finally:
        port.unplug()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
    assert version.startswith("6.5")
    assert (values.rpm, values.v_in, values.mc_fault_code) == (3000, 24.0, b"\x00")
    assert emulator.position == pytest.approx(0.25)
