"""Draws the wiring of data and of power for the build guide, from the shipped configuration of the truck.

python docs/pictures/wiring.py
"""

from pathlib import Path
from typing import Any

from matplotlib.patches import FancyBboxPatch

from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.figures import new_figure, write_figure
from monstertruckd.tools.shipped import shipped

PICTURES = Path(__file__).resolve().parent
NAMES = {
    "drive": "drive controller\nEPOS 24/1, RS232 by FTDI",
    "steering": "servo controller\nMicro Maestro 6",
    "compass": "compass\nOS4000",
    "stabiliser": "stabiliser\n2 x AX-12A by USB2Dynamixel",
    "lidar": "lidar\nURG-04LX",
    "camera": "camera\nUVC",
}


def box(axes: Any, x: float, y: float, text: str, colour: str, width: float = 2.6, height: float = 0.72) -> None:
    """A named box around (x, y)."""
    patch = FancyBboxPatch(
        (x - width / 2, y - height / 2), width, height, boxstyle="round,pad=0.05", facecolor=colour, edgecolor="#444"
    )
    axes.add_patch(patch)
    axes.text(x, y, text, ha="center", va="center", fontsize=8.5)


def line(axes: Any, begin: tuple[float, float], end: tuple[float, float], text: str = "", colour: str = "#333") -> None:
    """A cable."""
    axes.plot([begin[0], end[0]], [begin[1], end[1]], color=colour, linewidth=1.6, zorder=0)
    if text:
        x, y = (begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2
        label = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
        axes.text(x, y, text, ha="center", va="center", fontsize=7.5, color=colour, bbox=label)


def sheet(title: str, width: float, height: float) -> tuple[Any, Any]:
    """An empty drawing."""
    figure = new_figure(width, height)
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_title(title, loc="left", fontsize=11)
    return figure, axes


def data(config: TruckConfig) -> None:
    """Computer, hubs, ports and devices."""
    figure, axes = sheet("Data: which device hangs on which hub and port", 9.6, 5.4)
    hubs: dict[str, list[tuple[str, int]]] = {}
    for role, device in config.devices.present().items():
        hubs.setdefault(str(getattr(device.port, "hub", "path")), []).append((role, getattr(device.port, "port", 0)))
    rows = [(hub, role, port) for hub, ports in hubs.items() for role, port in sorted(ports, key=lambda p: p[1])]
    top = len(rows)
    box(axes, 0.0, top / 2 - 0.5, "computer", "#d6e4f0")
    for hub in hubs:
        ys = [top - 1 - k for k, row in enumerate(rows) if row[0] == hub]
        y = sum(ys) / len(ys)
        box(axes, 4.2, y, f"supplied hub {hub}", "#e8e8e8")
        line(axes, (1.35, top / 2 - 0.5), (2.85, y), "USB")
    for k, (hub, role, port) in enumerate(rows):
        y = top - 1 - k
        ys = [top - 1 - n for n, row in enumerate(rows) if row[0] == hub]
        box(axes, 9.0, y, NAMES.get(role, role), "#f5e6cc" if role in ("drive", "steering") else "#e3f0d8", width=3.4)
        line(axes, (5.55, sum(ys) / len(ys)), (7.25, y), f"port {port}")
    axes.set_xlim(-1.6, 11.0)
    axes.set_ylim(-0.7, top - 0.2)
    write_figure(figure, PICTURES / "wiring-data.png")


def power() -> None:
    """Pack, fuse, converters, loads, and the deadman line."""
    figure, axes = sheet("Power, and the deadman line", 9.6, 5.4)
    red, blue = "#b03030", "#2050a0"
    box(axes, 0.0, 2.0, "6S LiPo, 22.2 V\nin its bag", "#f6d0d0")
    box(axes, 3.6, 2.0, "fuse 15 A\nmain switch", "#f6d0d0", width=2.0)
    line(axes, (1.35, 2.0), (2.55, 2.0), "25.2 V", red)
    loads = (
        (4.4, "drive controller\nEPOS 24/1", "direct", red),
        (3.2, "converter 5 V, 5 A\ncomputer", "", red),
        (2.0, "converter 5 V, 4 A\nboth supplied hubs", "", red),
        (0.8, "converter 6 V, 10 A\nsteering servos", "", red),
        (-0.4, "converter 11.1 V, 3 A\nAX-12A", "", red),
    )
    for y, text, note, colour in loads:
        box(axes, 7.6, y, text, "#f5e6cc", width=2.9)
        line(axes, (4.65, 2.0), (6.1, y), note, colour)
    box(axes, 11.8, 4.4, "motor", "#e8e8e8", width=1.4)
    line(axes, (9.1, 4.4), (11.05, 4.4), "", red)
    box(axes, 11.8, 0.8, "servo\ncontroller", "#f5e6cc", width=1.6)
    line(axes, (9.1, 0.8), (10.95, 0.8), "signal", "#333")
    line(axes, (11.8, 1.2), (11.8, 3.8), "deadman: channel\nto quick-stop input", blue)
    line(axes, (11.8, 3.8), (8.6, 3.8), "", blue)
    line(axes, (8.6, 3.8), (8.6, 3.98), "", blue)
    line(axes, (0.0, 1.6), (0.0, -1.2), "", "#333")
    line(axes, (0.0, -1.2), (11.8, -1.2), "divider 10 : 1 to analog input, pack voltage", "#333")
    line(axes, (11.8, -1.2), (11.8, 0.4), "", "#333")
    axes.set_xlim(-1.6, 13.2)
    axes.set_ylim(-1.7, 5.1)
    write_figure(figure, PICTURES / "wiring-power.png")


if __name__ == "__main__":
    data(load_config(shipped("configs/truck.yaml"), TruckConfig)[0])
    power()
