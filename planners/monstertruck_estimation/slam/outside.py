"""Off-board localisation: pose in map from odometry and corrections sent by clients."""

import asyncio

import numpy as np

from monstertruck_estimation.correction import SmoothedCorrection
from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_estimation.slam.outside_map import OutsideMap
from monstertruck_estimation.slam.service import carried_on
from monstertruck_estimation.transforms import planar
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_runtime.requests import Sequences, examine
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import LocalisationStatus, OdometryUse, SlamHealth
from monstertruck_schemas.plan import MAX_COORDINATE
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import LocalisationRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState, Odometry, Transform


class OutsideLocalisation:
    """Follow odometry with the latest correction of one client, which must renew it within its lease.

    Requests are checked like drive requests: nonce, sequence, age and role of the sender. During the lease of one
    source, corrections of others are refused. Without corrections, the pose continues by odometry with status lost.

    Args:
        config: rate limit, jump and deviation.
        clock: the service's clock.
        requests: ``req/localisation``.
        gate: state of the gate.
        odometry: pose in odom.
        pose: publisher of ``state/pose``.
        health: publisher of ``health/slam``.
        events: sink of refusals, and of reports that the pose is lost or found.
        max_age: see ``GateConfig.max_request_age`` (s).
        maps: publishes the clients' maps; None if the robot has its own map.
    """

    name = ServiceName.SLAM.value

    def __init__(
        self,
        config: SlamConfig,
        clock: Clock,
        *,
        requests: Mailbox[LocalisationRequest],
        gate: Subscription[GateState],
        odometry: Mailbox[Odometry],
        pose: Publisher[Odometry],
        health: Publisher[SlamHealth],
        events: EventSink,
        max_age: float,
        maps: OutsideMap | None = None,
    ) -> None:
        self._clock = clock
        self._requests, self._gate, self._odometry = requests, gate, odometry
        self._pose, self._health, self._events = pose, health, events
        self._max_age, self._maps = max_age, maps
        self._sequences = Sequences(max_age)
        self._correction = SmoothedCorrection(config.slew, config.jump)
        deviation, turn = config.deviation
        self._covariance = np.diag((deviation**2, deviation**2, turn**2)).ravel()
        self._latest: Odometry | None = None
        self._corrected_at: Odometry | None = None
        """Odometry at the latest correction."""
        self._source, self._until = "", 0
        """Client that localises, and the end of its lease (ns)."""
        self._status = LocalisationStatus.SEARCHING
        self._corrections = 0
        self._refused = 0
        self._said: dict[Reason, int] = {}
        """Time of the last report of a refusal (ns), by reason."""
        self._due = 0

    def frames(self) -> tuple[Transform, ...]:
        """Return the published pose of odom in map."""
        stamp = 1 if self._latest is None else self._latest.stamp
        return (planar("map", "odom", stamp, self._correction.value),)

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled."""
        ready()
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._take_corrections())
            tasks.create_task(self._follow())
            if self._maps is not None:
                tasks.create_task(self._maps.run())

    async def _take_corrections(self) -> None:
        async for request in self._requests:
            try:
                self._take(request)
            except RequestRefusedError as error:
                self._refused += 1
                now, quiet = self._clock.now(), SECOND  # minimum time between two events with the same reason, ns
                if now - self._said.get(error.refusal, -quiet) >= quiet:
                    self._said[error.refusal] = now
                    self._events(error.refusal, Severity.WARNING, request.source, f"localisation refused: {error}")

    def _take(self, request: LocalisationRequest) -> None:
        """Apply a correction.

        Raises:
            RequestRefusedError: the sender lacks permission, another client localises, or the request is not a pose.
        """
        now, correction = self._clock.now(), request.correction
        examine(request, self._gate.latest, self._sequences, now, self._max_age)
        if now < self._until and request.source != self._source:
            raise RequestRefusedError(Reason.BUSY, f"{self._source} localises the robot")
        numbers = (correction.x, correction.y, correction.yaw)
        if max(map(abs, numbers)) > MAX_COORDINATE:
            raise RequestRefusedError(Reason.BAD_INPUT, f"correction: expected at most {MAX_COORDINATE:g} m and rad")
        found = self._status is not LocalisationStatus.LOCALISED
        self._correction.set_target(numbers, at_once=found)
        self._source, self._until = request.source, now + round(request.lease * SECOND)
        self._corrected_at = self._latest
        self._corrections += 1
        if found:
            self._status = LocalisationStatus.LOCALISED
            self._events(Reason.POSE_FOUND, Severity.INFO, self.name, f"by {request.source}")

    async def _follow(self) -> None:
        async for message in self._odometry:
            before, self._latest = self._latest, message
            elapsed = 0.0 if before is None else max(message.stamp - before.stamp, 0) / SECOND
            odom: Pose2 = (message.pose.x, message.pose.y, message.pose.yaw)
            x, y, yaw = self._correction.pose(odom, elapsed)
            covariance = self._covariance
            if self._corrected_at is not None:
                covariance = carried_on(covariance, self._corrected_at, message, self._correction.value[2])
            update = {
                "frame": "map",
                "seq": self._pose.next_seq(),
                "pose": Pose2D(x=x, y=y, yaw=yaw),
                "pose_covariance": covariance,
            }
            self._pose.put(message.model_copy(update=update))
            self._report(self._clock.now())

    def _report(self, now: int) -> None:
        if self._status is LocalisationStatus.LOCALISED and now >= self._until:
            self._status = LocalisationStatus.LOST
            text = f"{self._source} stopped sending corrections: the pose follows odometry"
            self._events(Reason.POSE_LOST, Severity.WARNING, self.name, text)
        if now < self._due:
            return
        self._due = now + SECOND // 10
        self._health.put(
            SlamHealth(
                stamp=now,
                received=now,
                seq=self._health.next_seq(),
                frame="map",
                standing=self._status,
                accepted=self._status is LocalisationStatus.LOCALISED,
                overlap=0.0,
                residual=0.0,
                degeneracy=0.0,
                direction=0.0,
                scans=self._corrections,
                rejected=self._refused,
                odometry=OdometryUse.USED,
            )
        )
