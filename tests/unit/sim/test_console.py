"""Faults by standard input: an unknown word is answered by all that are known, the cable's too."""

import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.emulation import EmulatorSetup
from monstertruck_runtime.clock import VirtualClock, VirtualLoop
from monstertruck_runtime.errors import InputError
from monstertruck_sim.console import Emulated
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World


@pytest.mark.parametrize("device", ["lidar", "drive", "steering", "compass"])
@pytest.mark.parametrize("words", [["help"], ["nonsense"], []])
def test_the_answer_names_faults_of_the_device_and_of_its_cable(device: str, words: list[str]):
    loop = VirtualLoop()
    try:
        clock, port = VirtualClock(loop), MemoryPort(device)
        kind = DEVICES.named(device)
        setup = EmulatorSetup(kind.role.name, None, clock, World(WorldConfig(), 0), 0, port)
        emulated = Emulated(kind.emulator_factory()(setup), port)
        with pytest.raises(InputError) as refused:
            emulated.command(list(words))
        assert "known:" in str(refused.value)
        assert "of its cable: plug, unplug, power-cycle, line stalled|deaf on|off" in str(refused.value)
        with pytest.raises(InputError, match=r"^of its cable: plug"):
            emulated.command(["line"])
    finally:
        loop.close()
