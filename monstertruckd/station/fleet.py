"""Overview of all robots for browsers that watch the fleet: position, gate, battery and link of each."""

import asyncio
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any, Final

from monstertruck_runtime.client import TruckClient, Watched
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.sensor import Battery
from monstertruck_schemas.state import Odometry
from monstertruckd.station import frames
from monstertruckd.station.feed import RobotFeed
from monstertruckd.station.viewer import Viewer

FLEET_PERIOD: Final = 0.5
"""Time between checks of all robots (s)."""


class RobotSnapshot:
    """Latest pose and battery state of one robot, decoded at every check, not at every message.

    Args:
        client: session with the robot.
        clock: clock of the station.
    """

    def __init__(self, client: TruckClient, clock: Clock) -> None:
        self.client = client
        self._clock = clock
        self._stack = ExitStack()
        self._pose: Watched[Odometry] = self._stack.enter_context(client.watch(topics.POSE))
        self._battery: Watched[Battery] = self._stack.enter_context(client.watch(topics.BATTERY))
        self._changes: dict[str, tuple[int | None, int]] = {}
        """Latest stamp of each topic, and its arrival time (ns of the station's clock)."""

    def row(self) -> dict[str, Any]:
        """Return the robot's row on the page; all keys exist even without messages."""
        now, pose, battery = self._clock.now(), self._pose.latest, self._battery.latest
        old = self._is_old(topics.POSE.name, pose, now)
        if self._is_old(topics.BATTERY.name, battery, now):
            battery = None
        return {
            "pose": None if pose is None else [round(v, 3) for v in (pose.pose.x, pose.pose.y, pose.pose.yaw)],
            "speed": None if pose is None else round(pose.twist.vx, 3),
            "old": old,
            "voltage": None if battery is None else battery.voltage,
            "level": None if battery is None else battery.level.value,
        }

    def _is_old(self, name: str, message: Message | None, now: int) -> bool:
        """Return whether the latest message of a topic has not changed for more than 2 s."""
        stamp = None if message is None else message.stamp
        before, since = self._changes.get(name, (None, now))
        self._changes[name] = stamp, now if stamp != before else since
        # 2.0: time without a new message before a pose is shown as old, and a battery as unknown (s)
        return (now - self._changes[name][1]) / SECOND > 2.0

    def close(self) -> None:
        """End the subscriptions; the session may already be closed."""
        self._stack.close()


class FleetBoard:
    """Creates one frame with all robots for the browsers that watch the fleet; subscribes only while a browser watches.

    Args:
        feeds: feeds of all robots by name; more may be added.
        clock: clock of the station.
    """

    def __init__(self, feeds: Mapping[str, RobotFeed], clock: Clock) -> None:
        self._feeds = feeds
        self._clock = clock
        self._viewers: set[Viewer] = set()
        self._watched = asyncio.Event()
        self._snapshots: dict[str, RobotSnapshot] = {}
        self._rows: dict[str, dict[str, Any]] = {}
        """Latest row of each robot, shown as old when the robot is gone."""

    def show(self, viewer: Viewer, on: bool) -> None:
        """Start or stop showing the fleet in a browser."""
        (self._viewers.add if on else self._viewers.discard)(viewer)
        if self._viewers:
            self._watched.set()
        else:
            self._watched.clear()

    async def run(self) -> None:
        """Update the browsers until cancelled."""
        try:
            while True:
                await self._watched.wait()
                frame = self._look()
                for viewer in self._viewers:
                    viewer.show("fleet", frame)
                await self._clock.sleep(FLEET_PERIOD)
                if not self._viewers:
                    self._leave()
        finally:
            self._leave()

    def _look(self) -> str:
        for name, feed in self._feeds.items():
            snapshot = self._snapshots.get(name)
            if snapshot is not None and snapshot.client is not feed.client:
                self._snapshots.pop(name).close()
                snapshot = None
            if snapshot is None and feed.client is not None:
                snapshot = self._snapshots[name] = RobotSnapshot(feed.client, self._clock)
            if snapshot is not None:
                self._rows[name] = snapshot.row()
        return frames.text("fleet", robots=[self._row(name, feed) for name, feed in self._feeds.items()])

    def _row(self, name: str, feed: RobotFeed) -> dict[str, Any]:
        gate = feed.gate if feed.alive else None
        seen = self._rows.get(name, {"pose": None, "speed": None, "old": True, "voltage": None, "level": None})
        return seen | {
            "name": name,
            "alive": feed.alive,
            "old": seen["old"] or not feed.alive,
            "round_trip": None if feed.round_trip is None else round(feed.round_trip, 4),
            "mode": None if gate is None else gate.mode.value,
            "stopping": gate is not None and gate.stopping,
            "holder": None if gate is None else gate.holder,
            "reasons": [] if gate is None else [reason.value for reason in gate.reasons],
        }

    def _leave(self) -> None:
        while self._snapshots:
            self._snapshots.popitem()[1].close()
