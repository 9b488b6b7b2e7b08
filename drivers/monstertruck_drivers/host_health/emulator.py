"""Kernel files of a small four-core computer."""

from pathlib import Path
from typing import Final

from monstertruck_drivers.emulation import EmulatorSetup, FileTree
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.host_health.readings import FIRMWARE_THROTTLED
from monstertruck_runtime.clock import Clock

CORES: Final = 4


class HostEmulator(FaultyDevice):
    """Emulated board with one thermal zone, cpufreq, throttle counters and the Raspberry Pi firmware word.

    Faults (``inject``): ``temperature C``, ``busy SHARE``, ``memory SHARE`` (available), ``cap SHARE`` (of the clock),
    ``firmware HEX``, ``throttle`` (increments the counter), ``blind`` (no /sys at all), ``broken`` (/proc/stat is
    empty).

    Args:
        root: folder that replaces /.
        clock: time.
    """

    def __init__(self, root: Path, clock: Clock) -> None:
        self.name = "host"
        self._files = FileTree(root)
        self._clock = clock
        self._busy_ticks = self._ticks = 0
        self.faults = FaultTable(
            self.name,
            {
                "temperature C": 50.0,
                "busy SHARE": 0.25,
                "memory SHARE": 0.6,
                "cap SHARE": 1.0,
                "firmware HEX": self._set_firmware,
                "throttle": self._throttle,
                "blind|broken": 0,
            },
        )
        self._firmware = 0
        self._throttled = 0
        self.write()

    async def run(self) -> None:
        """Update the files until cancelled."""
        write_period = 0.5  # seconds between two writes
        while True:
            await self._clock.sleep(write_period)
            ticks = round(100 * CORES * write_period)  # processor ticks a second and core
            self._ticks += ticks
            self._busy_ticks += round(ticks * self.faults["busy"])
            self.write()

    def inject(self, fault: str, *values: str) -> None:
        """Start or end a fault, and update the files; see ``FaultyDevice``."""
        super().inject(fault, *values)
        self.write()

    def _set_firmware(self, word: str) -> None:
        self._firmware = int(word, 16)

    def _throttle(self) -> None:
        self._throttled += 1

    def write(self) -> None:
        """Update all files, each atomically."""
        idle = self._ticks - self._busy_ticks
        rows = [f"cpu  {self._busy_ticks} 0 0 {idle} 0 0 0 0 0 0"]
        rows += [f"cpu{core} {self._busy_ticks // CORES} 0 0 {idle // CORES} 0 0 0 0 0 0" for core in range(CORES)]
        self._files.put("proc/stat", "" if self.faults["broken"] else "\n".join([*rows, "intr 1", "ctxt 2"]))
        self._files.put("proc/loadavg", f"{self.faults['busy'] * CORES:.2f} 0.90 0.80 1/200 4711")
        memory_kib = 4_000_000
        available = round(memory_kib * self.faults["memory"])
        self._files.put("proc/meminfo", f"MemTotal: {memory_kib} kB\nMemFree: 1 kB\nMemAvailable: {available} kB")
        self._files.put("proc/self/statm", "20000 12000 3000 1 0 9000 0")
        for descriptor in range(7):
            self._files.put(f"proc/self/fd/{descriptor}", "")
        if not self.faults["blind"]:
            self._write_sys()
        else:
            self._files.remove("sys")

    def _write_sys(self) -> None:
        self._files.put("sys/class/thermal/thermal_zone0/temp", str(round(self.faults["temperature"] * 1000)))
        self._files.put("sys/class/thermal/thermal_zone1/temp", "-274000")
        self._files.put(FIRMWARE_THROTTLED, f"{self._firmware:x}")
        max_kilohertz = 1_800_000
        for core in range(CORES):
            folder = f"sys/devices/system/cpu/cpu{core}"
            self._files.put(f"{folder}/cpufreq/cpuinfo_max_freq", str(max_kilohertz))
            self._files.put(f"{folder}/cpufreq/scaling_max_freq", str(round(max_kilohertz * self.faults["cap"])))
            self._files.put(f"{folder}/cpufreq/scaling_cur_freq", str(round(max_kilohertz * self.faults["cap"] * 0.9)))
            self._files.put(f"{folder}/thermal_throttle/core_throttle_count", str(self._throttled))


def emulated(setup: EmulatorSetup) -> HostEmulator:
    """Create the files of a simulated truck's computer."""
    return HostEmulator(setup.root, setup.clock)
