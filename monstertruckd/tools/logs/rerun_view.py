"""A log as a rerun recording: scans, map, path, frames, pictures, states, events and plots, with their layout."""

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from monstertruck_planners.collision import scan_points
from monstertruck_runtime.clock import is_date
from monstertruck_runtime.errors import CommandFailedError, ConfigError, InputError
from monstertruck_runtime.small_files import whole_file
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event, LogLevel, LogRecord, Severity, Stop
from monstertruck_schemas.health import HealthTable
from monstertruck_schemas.plan import Path as TruckPath
from monstertruck_schemas.sensor import CompressedImage, LaserScan
from monstertruck_schemas.state import (
    GROUND_UNKNOWN,
    ROUGHNESS_STEP,
    TILT_STEP,
    GateState,
    Grid,
    Ground,
    Odometry,
    Transforms,
)
from monstertruckd.recorder.reader import LogReader, open_log, spare_log
from monstertruckd.tools.logs.messages import ALL, Progress, Selection, real_offset
from monstertruckd.tools.logs.report.signals import FIGURES, Curve, DrivenPath, Figure

TIMELINE: Final = "time"
"""Real time if the log has it, otherwise daemon time."""
APPLICATION: Final = "monstertruckd"

_CAMERA: Final = "camera"
_FIRST: Final = ("Speed", "Steering commanded", "Cross-track error", "Battery", "Lateness of the control tick")
"""Figures visible when the recording opens."""
_SCAN, _PATH, _WAY, _TRUCK = (39, 104, 211), (120, 130, 145), (217, 83, 44), (28, 154, 104)
_LEVELS: Final = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}
_JOURNAL: Final = {
    LogLevel.DEBUG: "DEBUG",
    LogLevel.INFO: "INFO",
    LogLevel.WARNING: "WARN",
    LogLevel.ERROR: "ERROR",
    LogLevel.FATAL: "CRITICAL",
}


def convert(
    log: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> Path:
    """Write a log as the rerun recording ``output``, with its layout, atomically.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a message in it is invalid, or ``output`` cannot be written or is a log.
    """
    reader = open_log(log)
    offset = real_offset(reader)
    output = Path(output)
    try:
        spare_log(output)
        output.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(output) as part:
            part.open("wb").close()
            _record(reader, part, offset, selection, progress)
    except (OSError, RuntimeError) as error:  # rerun raises RuntimeError
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{output}: cannot be written: {why}") from None
    return output


def _record(reader: LogReader, output: Path, offset: int, selection: Selection, progress: Progress | None) -> None:
    name, stem = (os.fsencode(text).decode(errors="backslashreplace") for text in (reader.path.name, reader.path.stem))
    with rr.RecordingStream(APPLICATION, recording_id=stem) as stream:
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.save(output)
        stream.send_recording_name(name)
        scene = Scene(stream, offset)
        scene.truck(reader)
        for entry, message in selection.of(reader, progress):
            scene.take(entry.topic, entry.log_time, message)
        scene.finish()
        stream.send_blueprint(blueprint(scene.entities))
        stream.flush()
    stream.disconnect()


class Scene:
    """Sends messages to a recording; curves are collected and sent as columns at the end.

    Args:
        stream: open recording.
        offset: real minus daemon time (ns).
    """

    def __init__(self, stream: rr.RecordingStream, offset: int) -> None:
        self._stream = stream
        self._offset = offset
        self._dated: bool | None = None
        self._curves: dict[str, list[tuple[Figure, Curve]]] = {}
        for figure in FIGURES:
            for curve in figure.curves:
                self._curves.setdefault(curve.topic.name, []).append((figure, curve))
        self._samples: dict[str, tuple[list[int], list[float]]] = {}
        self._way = DrivenPath()
        self._way_frame = "odom"
        self._states: dict[str, str] = {}
        self.entities: set[str] = set()
        """Signals and pictures present in the recording."""
        self._handlers: Mapping[str, Callable[[Any], None]] = {
            t.SCAN.name: self._scan,
            t.TRANSFORMS.name: self._transforms,
            t.MAP.name: self._grid,
            t.GROUND.name: self._ground,
            t.PATH.name: self._path,
            t.POSE.name: self._pose,
            t.CAMERA.name: self._image,
            t.GATE.name: self._gate,
            t.HEALTH.name: self._health,
            t.EVENT.name: self._event,
            t.STOP.name: self._stop,
            t.LOG.name: self._journal,
        }

    def truck(self, reader: LogReader) -> None:
        """Draw the robot as a box with the size in the log's configuration; nothing without a configuration."""
        with suppress(InputError, ConfigError):
            self.box(reader.config().get("geometry", {}))

    def box(self, geometry: Mapping[str, Any]) -> None:
        """Draw a box with the size in this section of a configuration, and an arrow ahead; nothing without a size."""
        length, width = geometry.get("length"), geometry.get("width")
        if length is None or width is None:
            return
        height = 0.15  # height of the truck's box (m), which is not configured
        box = rr.Boxes3D(sizes=[(length, width, height)], centers=[(0.0, 0.0, height / 2)], colors=_TRUCK)
        self._stream.log("truck", rr.CoordinateFrame("base"), box, static=True)
        ahead = rr.Arrows3D(vectors=[(length, 0.0, 0.0)], origins=[(0.0, 0.0, height)], colors=_TRUCK, radii=0.012)
        self._stream.log("truck/ahead", rr.CoordinateFrame("base"), ahead, static=True)

    def take(self, topic: str, log_time: int, message: Message) -> None:
        """Show one message at its log time."""
        for figure, curve in self._curves.get(topic, ()):
            value = curve.value(message)
            if value is not None and math.isfinite(value):
                times, values = self._samples.setdefault(entity(figure, curve), ([], []))
                times.append(log_time)
                values.append(value)
        if (handler := self._handlers.get(topic)) is not None:
            if self._dated is None:
                self._dated = is_date(log_time + self._offset)
            self._set_time(log_time)
            handler(message)

    def flush(self) -> None:
        """Send the curves collected since the last call."""
        names = {entity(figure, curve): curve.label for figure in FIGURES for curve in figure.curves}
        self.entities |= self._samples.keys()
        for path, (times, values) in self._samples.items():
            self._stream.log(path, rr.SeriesLines(names=names[path]), static=True)
            self._stream.send_columns(path, [self._column(times)], rr.Scalars.columns(scalars=values))
        self._samples.clear()

    def finish(self) -> None:
        """Send the collected curves and the driven path."""
        self.flush()
        if len(self._way.points) > 1:
            strip = [(x, y, 0.01) for _, x, y in self._way.points]
            lines = rr.LineStrips3D([strip], colors=_WAY, radii=0.008)
            self._stream.log("way", rr.CoordinateFrame(self._way_frame), lines, static=True)

    def _set_time(self, log_time: int) -> None:
        if self._dated:
            self._stream.set_time(TIMELINE, timestamp=np.datetime64(log_time + self._offset, "ns"))
        else:
            self._stream.set_time(TIMELINE, duration=np.timedelta64(log_time, "ns"))

    def _column(self, times: list[int]) -> rr.TimeColumn:
        instants = np.array(times, np.int64)
        if is_date(times[0] + self._offset):
            return rr.TimeColumn(TIMELINE, timestamp=(instants + self._offset).astype("datetime64[ns]"))
        return rr.TimeColumn(TIMELINE, duration=instants.astype("timedelta64[ns]"))

    def _scan(self, scan: LaserScan) -> None:
        points = scan_points(scan, (0.0, 0.0, 0.0))
        positions = np.column_stack((points, np.zeros(len(points))))
        self._stream.log("scan", rr.CoordinateFrame(scan.frame), rr.Points3D(positions, colors=_SCAN, radii=0.012))

    def _transforms(self, tree: Transforms) -> None:
        for row in tree.transforms:
            transform = rr.Transform3D(
                translation=row.translation,
                quaternion=rr.Quaternion(xyzw=row.rotation),
                parent_frame=row.parent,
                child_frame=row.child,
            )
            self._stream.log(f"frames/{row.child}", transform)

    def _grid(self, grid: Grid) -> None:
        pixels = np.flipud(grid.cells.reshape(grid.height, grid.width)).view(np.uint8)
        layout = rr.components.ImageFormat(width=grid.width, height=grid.height, color_model="L", channel_datatype="U8")
        picture = rr.GridMap(
            data=pixels.tobytes(),
            format=layout,
            cell_size=grid.resolution,
            translation=(grid.origin.x, grid.origin.y, -0.01),
            rotation_axis_angle=rr.RotationAxisAngle((0.0, 0.0, 1.0), radians=grid.origin.yaw),
            colormap=rr.components.Colormap.RvizMap,
        )
        self._stream.log("map", rr.CoordinateFrame(grid.frame), picture)

    def _ground(self, ground: Ground) -> None:
        """Draw the ground: red for roughness, blue for tilt; unknown ground is transparent."""
        layers = np.stack((ground.roughness, ground.tilt)).reshape(2, ground.height, ground.width)
        known = layers[0] != GROUND_UNKNOWN
        # 0.03: roughness at full colour, m
        full = np.array((0.03 / ROUGHNESS_STEP, 0.35 / TILT_STEP)).reshape(2, 1, 1)
        red, blue = np.where(known, np.minimum(layers / full, 1.0) * 255.0, 0.0).astype(np.uint8)
        pixels = np.stack((red, np.zeros_like(red), blue, np.where(known, np.maximum(red, blue), 0)), axis=-1)
        layout = rr.components.ImageFormat(
            width=ground.width, height=ground.height, color_model="RGBA", channel_datatype="U8"
        )
        picture = rr.GridMap(
            data=np.ascontiguousarray(np.flipud(pixels), np.uint8).tobytes(),
            format=layout,
            cell_size=ground.resolution,
            translation=(ground.origin.x, ground.origin.y, -0.005),
            rotation_axis_angle=rr.RotationAxisAngle((0.0, 0.0, 1.0), radians=ground.origin.yaw),
        )
        self._stream.log("ground", rr.CoordinateFrame(ground.frame), picture)

    def _path(self, path: TruckPath) -> None:
        strip = [(x, y, 0.0) for x, y, _ in path.poses.reshape(-1, 3).tolist()]
        self._stream.log("path", rr.CoordinateFrame(path.frame), rr.LineStrips3D([strip], colors=_PATH, radii=0.008))

    def _pose(self, odometry: Odometry) -> None:
        self._way_frame = odometry.frame
        self._way.take(odometry.stamp, odometry.pose.x, odometry.pose.y)

    def _image(self, image: CompressedImage) -> None:
        self.entities.add(_CAMERA)
        self._stream.log(_CAMERA, rr.EncodedImage(contents=image.data, media_type=f"image/{image.format}"))

    def _gate(self, gate: GateState) -> None:
        self._state("states/gate", gate.mode.value)
        self._state("states/driven_by", gate.holder or "nobody")

    def _health(self, table: HealthTable) -> None:
        for row in table.services:
            self._state(f"states/{row.name}", row.state.value)

    def _state(self, path: str, state: str) -> None:
        if self._states.get(path) != state:
            self._states[path] = state
            self._stream.log(path, rr.StateChange(state=state))

    def _event(self, event: Event) -> None:
        text = f"{event.source}: {event.text or event.reason.text} [{event.reason.value}]"
        self._stream.log("events", rr.TextLog(text, level=_LEVELS[event.severity]))

    def _stop(self, stop: Stop) -> None:
        self._stream.log("events", rr.TextLog(stop.text, level="INFO" if stop.ordered else "ERROR"))

    def _journal(self, record: LogRecord) -> None:
        level = _JOURNAL[record.level]
        self._stream.log("events/journal", rr.TextLog(f"{record.name}: {record.text}", level=level))


def entity(figure: Figure, curve: Curve) -> str:
    """Path of a curve in the recording."""
    return f"signals/{_part(figure.title)}/{_part(curve.label)}"


def _part(text: str) -> str:
    return text.lower().replace(" ", "_")


def blueprint(entities: Collection[str]) -> rrb.Blueprint:
    """Return the layout: map and pictures on the left, plots on the right, states and events below.

    Args:
        entities: signals and pictures of the recording; views without data are omitted.
    """
    eye = rrb.EyeControls3D(position=(0.0, -0.4, 6.5), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 1.0, 0.0))
    place = rrb.Spatial3DView(
        name="Place",
        origin="/",
        contents=["+ /scan", "+ /map", "+ /ground", "+ /path", "+ /way", "+ /truck/**", "+ /frames/**"],
        eye_controls=eye,
        spatial_information=rrb.SpatialInformation(target_frame="map"),
    )
    camera = [rrb.Spatial2DView(name="Camera", origin=f"/{_CAMERA}")] if _CAMERA in entities else []
    shown = [figure for figure in FIGURES if any(entity(figure, curve) in entities for curve in figure.curves)]
    drive = [_plot(figure) for figure in shown if figure.title in _FIRST]
    others = [_plot(figure) for figure in shown if figure.title not in _FIRST]
    tabs = [rrb.Vertical(*plots, name=name) for name, plots in (("Drive", drive), ("More signals", others)) if plots]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(rrb.Vertical(place, *camera, row_shares=[3, 2][: 1 + len(camera)]), rrb.Tabs(*tabs)),
            rrb.Horizontal(
                rrb.StateTimelineView(name="States", origin="/states"),
                rrb.TextLogView(name="Events", origin="/events"),
            ),
            row_shares=[3, 1],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        auto_views=False,
        auto_layout=False,
    )


def _plot(figure: Figure) -> rrb.TimeSeriesView:
    whole = rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
    return rrb.TimeSeriesView(
        name=f"{figure.title}, {figure.unit}",
        origin=f"/signals/{_part(figure.title)}",
        axis_x=rrb.TimeAxis(view_range=whole),
        plot_legend=rrb.Corner2D.RightTop,
    )


_NOWHERE: Final = "http://127.0.0.1:9"
"""The discard port, where nothing listens."""


def show(recording: Path) -> None:
    """Show a rerun file until the viewer is closed.

    Raises:
        CommandFailedError: there is no display, or the viewer failed.
    """
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))):
        raise CommandFailedError(
            "the rerun viewer needs a display, but none is available; --save writes a file instead"
        )
    with tempfile.TemporaryDirectory(prefix="monstertruckd-view-") as folder:
        confined = environment(Path(folder))
        _run_viewer(["analytics", "disable"], confined, quiet=True)
        _run_viewer(["--bind", "127.0.0.1", "--port", "auto", "--hide-welcome-screen", str(recording)], confined)


def environment(folder: Path) -> dict[str, str]:
    """Environment of a viewer that keeps its files in ``folder`` and reaches no other host."""
    names = ("ALL_PROXY", "HTTP_PROXY", "HTTPS_PROXY")
    proxies = {name: _NOWHERE for upper in names for name in (upper, upper.lower())}
    home = {name: str(folder) for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME")}
    local = dict.fromkeys(("NO_PROXY", "no_proxy"), "127.0.0.1,localhost")
    return dict(os.environ) | proxies | home | local


def _run_viewer(arguments: list[str], confined: dict[str, str], *, quiet: bool = False) -> None:
    command = [sys.executable, "-m", "rerun_cli", *arguments]
    output = subprocess.DEVNULL if quiet else None
    done = subprocess.run(command, env=confined, stdout=output, stderr=output, check=False)  # noqa: S603  # our own
    if done.returncode:
        raise CommandFailedError(f"the rerun viewer ended with {done.returncode}; --save writes a file instead")
