"""Live screen with the truck's estimates, limits and services. Pure: messages in, screen out."""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.layout import Layout
from rich.panel import Panel
from rich.segment import Segment
from rich.style import Style
from rich.table import Table
from rich.text import Text

from monstertruck_estimation.transforms import FrameTree, planar_pose
from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import scan_points
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import NotFoundError
from monstertruck_runtime.stop_text import stop_lines
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event, Severity, Stop
from monstertruck_schemas.health import (
    CalibrationHealth,
    HealthTable,
    LoopHealth,
    RecorderHealth,
    ServiceHealth,
    ServiceState,
)
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude, Battery, LaserScan, SonarRanges
from monstertruck_schemas.state import GateMode, GateState, Odometry, Transforms
from monstertruck_schemas.topics import Topic
from monstertruckd.gate.sonars import arc

MODE_STYLE = {
    GateMode.DISARMED: "yellow",
    GateMode.ARMED: "cyan",
    GateMode.DRIVING: "bold green",
    GateMode.STOPPING: "bold yellow",
    GateMode.ESTOPPED: "bold red",
}
STATE_STYLE = {
    ServiceState.STARTING: "cyan",
    ServiceState.READY: "green",
    ServiceState.BACKOFF: "yellow",
    ServiceState.FAILED: "bold red",
    ServiceState.STOPPED: "dim",
}
EVENT_STYLE = {Severity.INFO: "green", Severity.WARNING: "yellow", Severity.ERROR: "bold red"}
HORIZON = 0.72
"""Vertical position of the truck in the scan view, as a fraction from the top: the lidar looks ahead."""


SILENCE: Final = 2.0
"""Maximum time without a message before a robot is gone (s); it publishes several times a second."""
GONE: Final = Style(color="bright_black")
"""Style of all values of a silent robot."""


@dataclass(slots=True)
class ScreenState:
    """Latest message of every kind that the screen shows."""

    robot: str
    heard: int
    """Arrival time of the latest message, or start of the wait for the first (ns of the station's clock)."""
    silence: float = 0.0
    """Time since ``heard`` (s)."""
    trouble: str = ""
    """Reason for the missing link to the robot."""
    began: int | None = None
    """Stamp of the first message (ns of the robot's clock)."""
    now: int = 0
    """Stamp of the latest message (ns of the robot's clock); ages are measured up to it."""
    gate: GateState | None = None
    odometry: Odometry | None = None
    scan: LaserScan | None = None
    sonar: SonarRanges | None = None
    transforms: Transforms | None = None
    attitude: Attitude | None = None
    battery: Battery | None = None
    calibration: CalibrationHealth | None = None
    tracker: TrackerState | None = None
    health: HealthTable | None = None
    loop: LoopHealth | None = None
    recorder: RecorderHealth | None = None
    stop: Stop | None = None
    events: deque[tuple[int, Event]] = field(default_factory=lambda: deque(maxlen=8))
    """Events with their arrival as UNIX time (ns)."""
    trail: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=2000))

    @property
    def why_stopped(self) -> list[str]:
        """Latest stop in a few lines while it still holds the truck; otherwise empty."""
        if self.stop is None or self.gate is None or self.gate.speed_limit > 0:
            return []
        silence = self.silence if self.gone else 0.0
        return stop_lines(self.stop, self.gate.stamp + round(silence * SECOND))

    @property
    def gone(self) -> bool:
        """Whether no message of the robot arrived recently, or ever."""
        return self.silence > SILENCE

    def take(self, message: Message, real: int = 0) -> None:
        """Store ``message`` if the screen shows its kind.

        Args:
            message: message of the robot.
            real: arrival as UNIX time (ns); events are shown with the time of day, which is the same on all screens.
        """
        self.now = message.stamp
        self.began = message.stamp if self.began is None else self.began
        if isinstance(message, GateState) and self.gate is not None and message.nonce != self.gate.nonce:
            self._forget_stop(self.gate.stamp)
        if (name := _FIELDS.get(type(message))) is not None:
            setattr(self, name, message)
        match message:
            case Odometry():
                spot = (message.pose.x, message.pose.y)
                if not self.trail or math.dist(spot, self.trail[-1]) > 0.03:
                    self.trail.append(spot)
            case Event():
                self.events.append((real, message))
            case _:
                pass

    def _forget_stop(self, until: int) -> None:
        """Drop a stop of the daemon's previous run, which ended at ``until`` (ns): it does not hold the current run."""
        if self.stop is not None and self.stop.stamp <= until:
            self.stop = None

    def old(self, name: str) -> str:
        """Return the age of a field's latest message in words; empty while it is current.

        The age uses the robot's clock, from the latest gate message. A message from before a restart of the computer
        is old, too.
        """
        message, limit = getattr(self, name), SHOWN[name].stale_after
        if message is None or self.gate is None or limit is None:
            return ""
        age = (self.gate.stamp - message.stamp) / SECOND
        if abs(age) <= max(limit, SILENCE):
            return ""
        return f"{age:.0f} s old" if age > 0 else "old"


def calibration_badge(health: CalibrationHealth) -> str:
    """Return the wizards by grade, and the expired ones: ``A drive, steering; expired: compass``."""
    good: dict[str, list[str]] = {}
    for state in health.wizards:
        good.setdefault("expired:" if state.expired else state.grade, []).append(state.wizard)
    return "; ".join(f"{grade} {', '.join(names)}" for grade, names in sorted(good.items()))


SHOWN: Final[dict[str, Topic[Any]]] = {
    "gate": topics.GATE,
    "odometry": topics.ODOMETRY,
    "scan": topics.SCAN,
    "sonar": topics.SONAR,
    "transforms": topics.TRANSFORMS,
    "attitude": topics.COMPASS,
    "battery": topics.BATTERY,
    "calibration": topics.CALIBRATION,
    "tracker": topics.TRACKER,
    "health": topics.HEALTH,
    "loop": topics.LOOP,
    "recorder": topics.RECORDER,
    "stop": topics.STOP,
}
"""Topics whose latest message ``ScreenState`` keeps, by field."""
_FIELDS: Final = {topic.model: name for name, topic in SHOWN.items()}


def draw(state: ScreenState, width: int, events: int = 6) -> RenderableType:
    """Draw the whole screen; below 104 columns, list only the services that are not ready.

    Once the robot has been silent for ``SILENCE`` seconds, a banner appears above its last values, which turn grey.

    Args:
        state: state to draw.
        width: width of the terminal (columns).
        events: lines for the latest events; the latest event is always complete.
    """
    layout = Layout()
    gone = state.gone
    paint: Callable[[RenderableType], RenderableType] = _Gone if gone else _as_it_is
    lines_of_events = _events(state, max(1, width - 4), events)
    below = Panel(Group(*lines_of_events), title="events (UTC)", border_style="dim")
    rows = [Layout(name="top", ratio=1), Layout(paint(below), name="events", size=max(1, len(lines_of_events)) + 2)]
    if lines := state.why_stopped:
        stop = Panel(Text("\n".join(lines), style="yellow", no_wrap=True), title="stopped", border_style="yellow")
        rows.insert(1, Layout(paint(stop), name="stop", size=len(lines) + 2))
    if gone:
        banner = _banner(state).wrap(_WRAPPING, max(1, width))
        rows.insert(0, Layout(Group(*banner), name="gone", size=len(banner)))
    layout.split_column(*rows)
    scan = Layout(paint(Panel(_Braille(state), title=_view_title(state), border_style="dim")))
    truck = Layout(paint(_truck(state)), size=40)
    if width >= 104:
        layout["top"].split_row(truck, scan, Layout(paint(_services(state)), size=34))
        return layout
    column = Layout()
    troubled = _troubled(state)
    column.split_column(Layout(paint(_services(state, troubled)), size=len(troubled) + 4), scan)
    layout["top"].split_row(truck, column)
    return layout


def _as_it_is(content: RenderableType) -> RenderableType:
    return content


class _Gone:
    """Last content, in grey."""

    def __init__(self, content: RenderableType) -> None:
        self._content = content

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Segment]:
        for segment in console.render(self._content, options):
            yield Segment(segment.text, GONE, segment.control)


def _banner(state: ScreenState) -> Text:
    said = "no robot" if state.began is None else "no data from the robot"
    text = f"{said} for {state.silence:.0f} s" + (f": {state.trouble}" if state.trouble else "")
    return Text(text, style="bold white on red")


def _troubled(state: ScreenState) -> list[ServiceHealth]:
    """Return the services that are not ready, limited to the space of a small screen."""
    services = state.health.services if state.health is not None else ()
    return [row for row in services if row.state is not ServiceState.READY][:4]


def _row(table: Table, name: str, value: str | Text, old: str = "") -> None:
    table.add_row(Text(name, style="dim"), Text(f"{value}, {old}", style=GONE) if old else value)


def _truck(state: ScreenState) -> Panel:
    table = Table.grid(padding=(0, 1))
    gate, odometry = state.gate, state.odometry
    if gate is not None:
        _row(table, "gate", Text(gate.mode_text.upper(), style=MODE_STYLE[gate.mode]))
        role = f" ({gate.role.value})" if gate.role and gate.role.value != gate.holder else ""
        _row(table, "driver", f"{gate.holder or '-'}{role}")
        if gate.form is not None and gate.twist is not None:
            vx, vy, wz = gate.twist.vx, gate.twist.vy, math.degrees(gate.twist.wz)
            _row(table, gate.form.value, f"{vx:+.2f} {vy:+.2f} m/s {wz:+.0f}°/s")
        _row(table, "lease left", "-" if gate.lease_left is None else f"{gate.lease_left * 1000:.0f} ms")
        _row(table, "why", Text("\n".join(r.text for r in gate.reasons[:3]) or "-", style="yellow"))
        _row(table, "limit", f"{gate.speed_limit:.2f} m/s, stops in {gate.stopping_distance * 100:.1f} cm")
        if gate.waiting:
            _row(table, "waiting", ", ".join(gate.waiting))
    if odometry is not None:
        speed = math.copysign(math.hypot(odometry.twist.vx, odometry.twist.vy), odometry.twist.vx)
        _row(table, "speed", f"{speed:+.2f} m/s {math.degrees(odometry.twist.wz):+.0f}°/s", state.old("odometry"))
    if state.battery is not None:
        volts = "-" if state.battery.voltage is None else f"{state.battery.voltage:.1f} V"
        _row(table, "battery", f"{volts} {state.battery.level.value}", state.old("battery"))
    if state.calibration is not None:
        _calibration(table, state.calibration)
    if odometry is not None:
        pose = f"{odometry.pose.x:+.2f} {odometry.pose.y:+.2f} m {math.degrees(odometry.pose.yaw):+.0f}°"
        _row(table, "pose", pose, state.old("odometry"))
    _tilt(table, state)
    _path(table, state)
    if state.loop is not None and state.loop.busy:
        _row(table, "busy", Text(state.loop.busy, style="bold yellow"))
    elif state.loop is not None:
        _row(table, "tick late", f"p99 {state.loop.lateness_p99 * 1e3:.1f} ms max {state.loop.lateness_max * 1e3:.1f}")
    if gate is not None and gate.weakened:  # last: it is constant, and a small screen cuts off the end
        _row(table, "weakened", Text("\n".join(gate.weakened), style="bold yellow"))
    old = f", {state.silence:.0f} s ago" if state.gone else ""
    return Panel(table, title=f"mt/{state.robot}{old}", border_style="dim")


def _calibration(table: Table, health: CalibrationHealth) -> None:
    if health.wizards:
        _row(table, "calibrated", calibration_badge(health))
    if health.proposed:
        _row(table, "proposed", Text(f"{health.proposed} (`calibrate accept`)", style="yellow"))


def _path(table: Table, state: ScreenState) -> None:
    """Add the progress on the path, and the steering difference that the tracker has learnt."""
    gate, tracker = state.gate, state.tracker
    if tracker is None:
        return
    done = _done(tracker)
    bar = "█" * round(done * 16)
    _row(table, "path", f"{bar:░<16} {done:4.0%}")
    waits = tracker.outcome is Reason.DRIVING and gate is not None and not gate.mode.active
    doing = "waits" if waits else tracker.outcome.value
    old = state.old("tracker") if tracker.outcome is Reason.DRIVING else ""  # silent after the path's end
    _row(table, "off path", f"{tracker.cross_track * 100:+.1f} cm {doing}", old)
    if tracker.steering_differs:
        _row(table, "steering", Text(tracker.steering_differs, style="yellow"))


def _tilt(table: Table, state: ScreenState) -> None:
    """Add the measured tilts of the body and of the lidar's plane."""
    if state.attitude is not None:
        roll, pitch = (math.degrees(angle) for angle in (state.attitude.roll, state.attitude.pitch))
        _row(table, "tilt", f"roll {roll:+.1f}° pitch {pitch:+.1f}°", state.old("attitude"))
    if state.scan is not None and state.scan.tilt is not None:
        _row(table, "lidar", f"{math.degrees(state.scan.tilt):.1f}° from level", state.old("scan"))


def _done(tracker: TrackerState) -> float:
    """Return the fraction of the path driven; after a lap the tracker already measures along the next lap."""
    if tracker.outcome in (Reason.GOAL_REACHED, Reason.GOAL_MISSED):
        return 1.0
    return tracker.along / tracker.length if tracker.length else 0.0


def _why(row: ServiceHealth) -> str:
    """Return why a service fails or is impaired; only the first line of a traceback."""
    return "" if row.state is ServiceState.READY and row.reason is Reason.OK else row.detail.partition("\n")[0]


def _services(state: ScreenState, shown: Sequence[ServiceHealth] | None = None) -> Panel:
    """Panel of all services, or of those ``shown`` with the number of ready services."""
    table = Table.grid(padding=(0, 1))
    services = state.health.services if state.health is not None else ()
    for row in services if shown is None else shown:
        age = max(0, state.now - row.since) / 1e9
        table.add_row(
            row.name,
            Text(row.state.value, style=STATE_STYLE[row.state]),
            Text(f"{age:.0f} s" if age < 100 else f"{age / 60:.0f} min", style="dim"),
            Text(f"↻{row.restarts}" if row.restarts else "", style="yellow"),
        )
    parts: list[RenderableType] = [table]
    if shown is None:
        parts += [Text(f"{row.name}: {detail}", style="yellow") for row in services if (detail := _why(row))]
    elif services:
        parts.append(Text(f"{sum(row.state is ServiceState.READY for row in services)} of {len(services)} ready"))
    if state.recorder is not None and state.recorder.recording:
        parts.append(Text(f"● recording {state.recorder.bytes_written / 1e6:.1f} MB unpacked", style="red"))
        if state.recorder.lost:
            parts.append(Text(state.recorder.lost, style="bold red"))
    elif state.recorder is not None and state.recorder.reason is not Reason.OK:
        parts.append(Text(f"NOT RECORDING: {state.recorder.reason.text}", style="bold red"))
    return Panel(Group(*parts), title="services", border_style="dim")


def _events(state: ScreenState, width: int, count: int) -> list[Text]:
    """Return lines of the latest events: as many complete events as fit ``count`` lines, but always the latest."""
    lines: list[Text] = []
    for real, event in reversed(state.events):
        text = Text(f"{str(np.datetime64(real // SECOND, 's'))[-8:]}  ", style="dim")
        text.append(f"{event.source}: ", style="not dim bold")
        text.append(event.text or event.reason.text, style=f"not dim {EVENT_STYLE[event.severity]}")
        text.append(f"  [{event.reason.value}]")
        above = text.wrap(_WRAPPING, width)
        if lines and len(lines) + len(above) > count:
            break
        lines = [*above, *lines]
    return lines


_WRAPPING: Final = Console()
"""Console for line breaking; never written to."""


def _view_title(state: ScreenState) -> str:
    names = {"scan": "scan"} if state.scan is not None or state.sonar is None else {}
    names |= {} if state.sonar is None else {"sonar": "sonars"}
    sensors = [f"{word} {old}" if (old := state.old(name)) else word for name, word in names.items()]
    return f"{', '.join(sensors)} and trail, robot frame"


class _Braille:
    """Scan points, sonar echoes and trail as braille dots, forward up, scaled to the available space."""

    def __init__(self, state: ScreenState) -> None:
        self._state = state

    def __rich_console__(self, _console: object, options: object) -> "list[Text]":
        width: int = getattr(options, "max_width", 60)
        height: int = getattr(options, "height", None) or 20
        scale = min(width, height * 4 * HORIZON) / 2.6  # minimum distance shown ahead and to each side (m)
        cells = np.zeros((height, width), np.uint8)
        if self._state.scan is not None and not self._state.old("scan"):
            mount = _mount(self._state, self._state.scan.frame) or (0.0, 0.0, 0.0)
            _plot(cells, scan_points(self._state.scan, mount), scale)
        echo_cells, trail_cells = np.zeros_like(cells), np.zeros_like(cells)
        _plot(echo_cells, _echo_points(self._state), scale)
        _plot(trail_cells, _trail_points(self._state), scale)
        lines = [Text() for _ in range(height)]
        for line, *row in zip(lines, cells.tolist(), echo_cells.tolist(), trail_cells.tolist(), strict=True):
            for bits, echo, trail in zip(*row, strict=True):
                style = "cyan" if bits else "magenta" if echo else "green"
                line.append(chr(0x2800 + (bits | echo | trail)), style=style)
        truck = lines[int(height * HORIZON)]
        truck.plain = _with_arrow(truck.plain, width // 2)
        return lines


def _with_arrow(line: str, at: int) -> str:
    return f"{line[:at]}▲{line[at + 1 :]}"


def _mount(state: ScreenState, frame: str) -> tuple[float, float, float] | None:
    """Return the pose (x, y, yaw) of a sensor in base (m, m, rad); None if unknown."""
    if state.transforms is None:
        return None
    try:
        return planar_pose(FrameTree(state.transforms.transforms).lookup("base", frame))
    except NotFoundError:
        return None


def _echo_points(state: ScreenState) -> Array:
    """Return points (n, 2) on the arcs of the echoes in base (m), for the sonars whose mounting is known."""
    arcs = [np.empty((0, 2))]
    if state.sonar is not None and not state.old("sonar"):
        for echo in state.sonar.sonars:
            place = _mount(state, f"sonar_{echo.name}")
            if echo.answered and echo.range is not None and place is not None:
                arcs.append(arc(place, echo.range, state.sonar.field_of_view / 2))
    return np.concatenate(arcs)


def _trail_points(state: ScreenState) -> Array:
    if state.odometry is None or not state.trail:
        return np.empty((0, 2))
    pose = state.odometry.pose
    offset = np.array(state.trail) - (pose.x, pose.y)
    cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
    turned: Array = offset @ np.array([[cos, -sin], [sin, cos]])
    return turned


_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint8)


def _plot(cells: NDArray[np.uint8], points: Array, scale: float) -> None:
    """Set the braille dots of ``points`` (x forward = up, y left = left) around the truck's place in ``cells``."""
    height, width = cells.shape
    column = np.round(width - points[:, 1] * scale).astype(int)
    row = np.round((int(height * HORIZON) + 0.5) * 4 - points[:, 0] * scale).astype(int)
    inside = (column >= 0) & (column < width * 2) & (row >= 0) & (row < height * 4)
    row, column = row[inside], column[inside]
    np.bitwise_or.at(cells, (row // 4, column // 2), _BITS[row % 4, column % 2])
