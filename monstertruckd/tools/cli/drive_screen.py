"""The screen of ``drive``: what is asked for, above what the robot makes of it. Pure."""

import math
from dataclasses import dataclass

from rich.console import RenderableType
from rich.layout import Layout
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from monstertruck_schemas.state import GateMode
from monstertruckd.tools.cli.driving_modes import SteeringMode
from monstertruckd.tools.cli.teleop import MODE_KEYS, STEPS, Teleop, TeleopRequest
from monstertruckd.tools.status import screen
from monstertruckd.tools.status.screen import ScreenState

HELP = "Enter arm  WASD drive  space stop  e E-STOP  r reset  x straight  q end"
ARROWS = {1: "▲ forward", -1: "▼ back", 0: "standing"}
HINTS = {
    None: "no state of the gate yet",
    GateMode.DISARMED: "disarmed: Enter arms",
    GateMode.ESTOPPED: "emergency stop: r resets, then Enter arms",
}


@dataclass(slots=True)
class Stream:
    """What goes to the robot."""

    request: TeleopRequest | None = None
    """Sent last; None = silence."""
    round_trip: float | None = None
    """Seconds to the robot and back; None = no answer."""
    trouble: str = ""
    """Why nothing can be sent."""
    refusal: str = ""
    """Why the newest order was refused."""


def draw(state: ScreenState, teleop: Teleop, stream: Stream, width: int) -> RenderableType:
    """The whole screen."""
    layout = Layout()
    layout.split_column(
        Layout(_controls(state, teleop, stream), size=6), Layout(screen.draw(state, width, events=4), ratio=1)
    )
    return layout


def _controls(state: ScreenState, teleop: Teleop, stream: Stream) -> Panel:
    table = Table.grid(padding=(0, 1))
    table.add_row(_asked(stream), Text(f"{teleop.speed:.2f} m/s (+/-)", style="bold"), _wheels(teleop), _link(stream))
    body = Table.grid()
    body.add_row(table)
    body.add_row(_modes(teleop))
    body.add_row(Text(HELP, style="dim", no_wrap=True, overflow="ellipsis"))
    body.add_row(_message(state, stream))
    return Panel(body, title="drive: moves only while a key is held", border_style="dim")


def _message(state: ScreenState, stream: Stream) -> Text:
    """What is wrong, or the key to press before anything moves."""
    if text := stream.trouble or stream.refusal:
        return Text(text, style="bold red", no_wrap=True, overflow="ellipsis")
    mode = None if state.gate is None else state.gate.mode
    return Text(HINTS.get(mode, ""), style="bold yellow")


def _asked(stream: Stream) -> Text:
    if stream.request is None:
        return Text("silent   ", style="dim")
    speed = stream.request.speed
    return Text(f"{ARROWS[(speed > 0) - (speed < 0)]:9}", style="bold green" if speed else "cyan")


def _wheels(teleop: Teleop) -> Text:
    cells = ["─"] * (2 * STEPS + 1)
    at = round(STEPS * (1.0 - teleop.steer / teleop.angle))
    cells[STEPS], cells[at] = "┼", "●"
    return Text(f"{''.join(cells)} {math.degrees(teleop.steer):+5.1f}°")


def _link(stream: Stream) -> Text:
    if stream.round_trip is None:
        return Text("no answer", style="bold red")
    return Text(f"round trip {stream.round_trip * 1e3:.1f} ms")


def _modes(teleop: Teleop) -> Text:
    text = Text(no_wrap=True)
    for key, mode in MODE_KEYS.items():
        text.append(f"{key} {mode.value}  ", style="reverse" if mode is teleop.mode else "dim")
    if teleop.mode is SteeringMode.HYBRID:
        text.append(f"z/c drift {math.degrees(teleop.drift):+.1f}°", style="bold")
    return text
