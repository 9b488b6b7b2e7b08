"""Figures of a demo run, from the log and the true states of the truck."""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.logs.summary import info
from monstertruckd.tools.simulation.operator import Lap


def log_figures(folder: Path) -> tuple[dict[str, int], int, tuple[Path, ...]]:
    """Return messages by topic, bytes, and files of a run's folder."""
    logs = sorted((folder / "logs").glob("*.mcap"))
    messages: dict[str, int] = {}
    for log in logs:
        for name, topic in info(log)["topics"].items():
            messages[name] = messages.get(name, 0) + topic["messages"]
    return messages, sum(log.stat().st_size for log in logs), (*logs, *folder.glob("map.png"))


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures of one lap."""

    lap: Lap
    truth: Array
    """Shape (n, 6): time s, x m, y m, yaw rad, speed m/s, stuck."""
    lateness_p99: float
    """Lateness of the control tick (s)."""
    lateness_max: float
    messages: dict[str, int] = field(default_factory=dict)
    """Number of messages by topic."""
    log_bytes: int = 0
    files: tuple[Path, ...] = ()
    digest: str | None = None
    """sha256 over (key, stamp, payload) of every logged message; virtual clock only."""
    speedup: float | None = None
    """Simulated seconds per real second; virtual clock only."""
    closed: bool = True
    """The path is a lap: its true closing error counts."""

    @property
    def outcome(self) -> Reason:
        """How the lap ended."""
        return self.lap.outcome

    @property
    def text(self) -> str:
        """Reason why the lap was aborted; empty if it was completed."""
        return self.lap.text

    def _driven(self) -> Array:
        times = self.truth[:, 0]
        during = (times >= self.lap.start / SECOND) & (times <= self.lap.end / SECOND + 1.0)
        return self.truth[during]

    @property
    def distance(self) -> float:
        """True distance travelled (m)."""
        return float(np.hypot(*np.diff(self._driven()[:, 1:3], axis=0).T).sum())

    @property
    def closing_error(self) -> float:
        """True distance between start and end of the closed lap (m)."""
        driven = self._driven()
        return float(np.hypot(*(driven[-1, 1:3] - driven[0, 1:3])))

    @property
    def collided(self) -> bool:
        """Whether the truck ever touched an obstacle."""
        return bool(self._driven()[:, 5].any())

    def rows(self) -> list[tuple[str, str]]:
        """Return name and value of every printed figure."""
        rows = [
            ("outcome", self.lap.outcome.text + (", COLLIDED" if self.collided else "")),
            ("lap time", f"{self.lap.seconds:.1f} s"),
            *self._stops_row(),
            *self._busy_row(),
            ("distance, true", f"{self.distance:.2f} m"),
            ("cross-track RMS", f"{self.lap.cross_track_rms * 100:.2f} cm"),
            *self._closing_row(),
            ("tick lateness p99", f"{self.lateness_p99 * 1e3:.2f} ms (max {self.lateness_max * 1e3:.2f} ms)"),
            ("messages", f"{sum(self.messages.values())} in {len(self.messages)} topics"),
            ("log size", f"{self.log_bytes / 1e6:.2f} MB, compressed"),
        ]
        if self.speedup is not None:
            rows.append(("speed", f"{self.speedup:.1f} x real time"))
        if self.digest is not None:
            rows.append(("sha256", self.digest))
        return rows + [("file", str(file)) for file in self.files]

    def _stops_row(self) -> list[tuple[str, str]]:
        """Return the row of the stops; empty for a lap without a stop."""
        counts = Counter(reason.text for reason in self.lap.stops)
        text = ", ".join(f"{count} x {reason}" for reason, count in counts.items())
        again = f"; armed again {self.lap.armed_again} x" if self.lap.armed_again else ""
        return [("stopped on the way", text + again)] if text else []

    def _busy_row(self) -> list[tuple[str, str]]:
        """Return advice for a lap with stops on a busy computer; empty for others."""
        # Minimum lateness of a busy computer, s: one control tick.
        if not (self.lap.stops and self.lateness_p99 > 0.02):
            return []
        return [
            ("busy computer", f"ticks were {self.lateness_p99 * 1e3:.0f} ms late: end other programs, or use --fast")
        ]

    def _closing_row(self) -> list[tuple[str, str]]:
        if not self.closed:
            return []
        return [("true closing error", f"{self.closing_error * 100:.1f} cm (goal 30 cm)")]

    def as_json(self) -> dict[str, object]:
        """Return everything as plain data."""
        return {
            "outcome": self.lap.outcome.value,
            "text": self.lap.text,
            "collided": self.collided,
            "lap_s": self.lap.seconds,
            "distance_m": self.distance,
            "cross_track_rms_m": self.lap.cross_track_rms,
            "stops": [reason.value for reason in self.lap.stops],
            "armed_again": self.lap.armed_again,
            "closing_error_m": self.closing_error if self.closed else None,
            "lateness_p99_s": self.lateness_p99,
            "lateness_max_s": self.lateness_max,
            "messages": self.messages,
            "log_bytes": self.log_bytes,
            "speedup": self.speedup,
            "sha256": self.digest,
            "files": [str(file) for file in self.files],
        }
