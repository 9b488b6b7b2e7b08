"""Current devices, each at its emulator: clocks, disturbances, and the time until an actuator without host stands.

One row for each device. `stand_ms`: from the last byte of a dead host to standstill of all motors, the worst of all
trials. `clock_ms`: maximum error of the stamps. `lost_ms`: from the loss of a transmitter to the message that reports
it, the worst trial. `step`, `deskew_mm`: of lidars (`devices_today_parts/lidars.py`). `trouble`: passed tests of
loss, damage, stalls, single bytes and unplugging, after each of which the driver must serve again, and of a wrong
device, which it must refuse. `foreign`: test in which another implementation agrees with the emulator's bytes. All runs
use the virtual clock. The last line is JSON.

    python benchmarks/devices_today.py [DEVICE ...]
"""

import importlib
import json
import pkgutil
import sys
from typing import Any

from benchmarks import devices_today_parts

GOALS = {"stand_ms": 300.0, "clock_ms": 5.0, "step": 1.0, "deskew_mm": 10.0}
"""Greatest figures allowed."""


def main(names: list[str]) -> int:
    rows: dict[str, dict[str, Any]] = {}
    for module in pkgutil.iter_modules(devices_today_parts.__path__):
        part = importlib.import_module(f"benchmarks.devices_today_parts.{module.name}")
        for name, measure in getattr(part, "ROWS", {}).items():
            if not names or name in names:
                rows[name] = measure()
                print(f"{name:16}", "  ".join(f"{key} {value}" for key, value in rows[name].items()), flush=True)
    bounded = all((row.get(name) or 0.0) <= most for row in rows.values() for name, most in GOALS.items())
    passed = all(row["trouble"].split("/")[0] == row["trouble"].split("/")[1] for row in rows.values())
    met, goals = bounded and passed, {**GOALS, "trouble": "all"}
    print(json.dumps({"bench": "devices_today", "figures": rows, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
