"""Kernel files of a Wi-Fi and a wired interface."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from monstertruck_drivers.emulation import EmulatorSetup, FileTree
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_runtime.clock import Clock

HEADER: Final = (
    "Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE\n"
    " face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22\n"
)
STYLES: Final = ("normal", "no_dot", "unsigned", "header", "missing")
ON_AIR: Final = 20_000
"""Traffic in each direction while connected (bytes/s)."""


class NetworkEmulator(FaultyDevice):
    """Emulated interfaces: ``wlan0`` with a signal, ``eth0`` with or without a cable, and ``lo``.

    Faults (``inject``): ``signal DBM``, ``style normal|no_dot|unsigned|header|missing`` (how /proc/net/wireless is
    printed), ``wifi on|off``, ``cable on|off``, ``remove`` (the Wi-Fi stick is unplugged), ``plug``, ``reset``
    (counters restart at 0).

    Args:
        root: folder that replaces /.
        clock: time.
    """

    def __init__(self, root: Path, clock: Clock) -> None:
        self.name = "link"
        self._files = FileTree(root)
        self._clock = clock
        self._signal: Callable[[int], float | None] = lambda _: -55.0
        """Signal at a time (ns), dBm; None: out of range."""
        self._style = "normal"
        self._present = True
        self.faults = FaultTable(
            self.name,
            {
                "signal DBM": self._fix,
                f"style {'|'.join(STYLES)}": self._set_style,
                "wifi on|off": True,
                "cable on|off": False,
                "remove": partial(self._plug, False),
                "plug": partial(self._plug, True),
                "reset": self._reset,
            },
        )
        self._bytes = 0
        self.write()

    async def run(self) -> None:
        """Keep the files up to date with the signal until cancelled."""
        signal_period = 0.5  # seconds between two changes of the signal
        while True:
            await self._clock.sleep(signal_period)
            self._bytes += round(ON_AIR * signal_period)
            self.write()

    def write(self) -> None:
        """Update all files, each atomically."""
        level = self._signal(self._clock.now()) if self.faults["wifi"] else None
        self._interface("lo", {"type": "772", "operstate": "unknown", "carrier": "1"})
        self._interface(
            "eth0", {"type": "1", "speed": "1000" if self.faults["cable"] else "-1", "device/vendor": "0x8086"}
        )
        self._carrier("eth0", bool(self.faults["cable"]))
        if self._present:
            self._interface("wlan0", {"type": "1", "phy80211/index": "0"})
            self._carrier("wlan0", level is not None)
        else:
            self._files.remove("sys/class/net/wlan0")
        self._wireless(level)

    def inject(self, fault: str, *values: str) -> None:
        """Start or end a fault, and update the files; see ``FaultyDevice``."""
        super().inject(fault, *values)
        self.write()

    def _fix(self, dbm: str) -> None:
        level = float(dbm)
        self._signal = lambda _: level

    def _set_style(self, style: str) -> None:
        if style not in STYLES:
            raise ValueError(style)
        self._style = style

    def _plug(self, present: bool) -> None:
        self._present = present

    def _reset(self) -> None:
        self._bytes = 0

    def _interface(self, name: str, files: dict[str, str]) -> None:
        counters = {"rx_bytes": self._bytes, "tx_bytes": self._bytes // 2, "rx_errors": 1, "tx_dropped": 2}
        for file, text in files.items():
            self._files.put(f"sys/class/net/{name}/{file}", text)
        for counter, value in counters.items():
            self._files.put(f"sys/class/net/{name}/statistics/{counter}", str(value))

    def _carrier(self, name: str, up: bool) -> None:
        self._files.put(f"sys/class/net/{name}/operstate", "up" if up else "down")
        self._files.put(f"sys/class/net/{name}/carrier", "1" if up else "0")

    def _wireless(self, level: float | None) -> None:
        if self._style == "missing":
            self._files.remove("proc/net/wireless")
            return
        dot = "" if self._style == "no_dot" else "."
        shown = 0 if level is None else round(level) + (256 if self._style == "unsigned" else 0)
        row = f" wlan0: 0000   54{dot}  {shown}{dot}  -256        0      0      0      3     42        0\n"
        self._files.put("proc/net/wireless", HEADER + (row if self._present and self._style != "header" else ""))


def emulated(setup: EmulatorSetup) -> NetworkEmulator:
    """Create the network of a simulated truck's computer."""
    return NetworkEmulator(setup.root, setup.clock)
