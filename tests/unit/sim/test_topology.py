"""A configuration that names hubs by topology is simulated with the names that a kernel would give."""

from pathlib import Path

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.config import Devices
from monstertruck_drivers.usb.tree import read_tree
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_sim.computer import EmulatedComputer


def test_controllers_get_buses_that_no_other_name_uses(tmp_path: Path):
    ports = {
        "drive": {"hub": "platform-soc-pci-0000:01:00.0-usb-0:1", "port": 2},
        "compass": {"hub": "pci-0000:00:14.0-usb-0:0", "port": 3},
        "steering": {"hub": "1-1", "port": 2},
    }
    kinds = {"drive": "epos", "compass": "os4000", "steering": "maestro"}
    devices = Devices.model_validate(
        {role: {"port": port, "driver": {"kind": kinds[role]}} for role, port in ports.items()}
    )

    async def main(clock: VirtualClock) -> None:
        cables = {role: MemoryPort(role) for role in ports}
        sysfs = EmulatedComputer(tmp_path, devices, cables, clock).computer().machine.sysfs
        found = {role: vars(device.port)["hub"] for role, device in devices.at_present(sysfs).present().items()}
        assert found == {"compass": "usb2", "drive": "3-1", "steering": "1-1"}
        assert {"2-3", "3-1.2", "1-1.2"} <= read_tree(sysfs).devices.keys()

    run_virtual(main)
