"""Service that publishes the fused odometry."""

from collections.abc import Sequence

from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_estimation.fusion.estimator import Fusion, FusionStatus
from monstertruck_estimation.inertial import InertialInput
from monstertruck_estimation.odometry import OdometryContext, OdometryService
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_schemas import topics
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import OdometryHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude, DriveFeedback, SteeringFeedback
from monstertruck_schemas.state import Odometry, ScanMotion


class FusionService(OdometryService):
    """``OdometryService`` that also uses the motion between scans and reports slip and compass disturbances.

    Args:
        fusion: the estimator.
        clock: the service's clock.
        drives: feedback of every driven shaft.
        steering: servo feedback; None for a body without steering.
        compass: headings and tilt; None without a compass.
        scans: motion between scans from a bounded, counted queue; None without a scan matcher.
        odometry: publisher of ``state/odometry``.
        pose: ``state/pose``; None: published by localisation.
        health: publisher of ``health/odometry``.
        events: sink of slip and disturbance reports.
        imu: measurements of the IMU; None without one.
        rate: publishing rate (1/s).
    """

    def __init__(
        self,
        fusion: Fusion,
        clock: Clock,
        *,
        drives: Sequence[Subscription[DriveFeedback]],
        steering: Subscription[SteeringFeedback] | None,
        compass: Subscription[Attitude] | None,
        scans: Mailbox[ScanMotion] | None,
        odometry: Publisher[Odometry],
        pose: Publisher[Odometry] | None,
        health: Publisher[OdometryHealth],
        events: EventSink,
        imu: InertialInput | None = None,
        rate: float = 50.0,
    ) -> None:
        super().__init__(
            fusion,
            clock,
            drives=drives,
            steering=steering,
            compass=compass,
            odometry=odometry,
            pose=pose,
            imu=imu,
            events=events,
            rate=rate,
        )
        self._fusion = fusion
        self._scans = scans
        self._health = health
        self._published: tuple[int, tuple[bool, bool]] | None = None

    def take(self) -> None:
        """Pass new messages to the estimator and report changes."""
        super().take()
        for motion in self._scans.drain() if self._scans is not None else ():
            self._fusion.observe_scan(motion)
        for change in self._fusion.changes():
            reason = Reason.WHEEL_SLIP if change.slipping else Reason.WHEEL_GRIP
            severity = Severity.WARNING if change.slipping else Severity.INFO
            self._events(reason, severity, self.name, change.text)
        status = self._fusion.status()
        self.report_compass(status.doubt, f"north at {status.north or 0:.2f} rad in odom")
        self._publish_health(status)

    def _publish_health(self, status: FusionStatus) -> None:
        now, trouble = self._clock.now(), (status.slipping, status.disturbed)
        if self._published is not None and trouble == self._published[1] and now - self._published[0] < SECOND:
            return
        self._published = (now, trouble)
        self._health.put(
            OdometryHealth(
                stamp=now,
                received=now,
                seq=self._health.next_seq(),
                frame="odom",
                slipping=status.slipping,
                disturbed=status.disturbed,
                sources=self._fusion.sources(now),
                north=status.north,
                trim=status.trim,
                left_out=sum(status.left_out.values()),
                waiting=self._fusion.waiting,
            )
        )

    def accepts_compass(self) -> bool:
        """Return True: a heading can be the first measurement."""
        return True


def build_fusion(config: FusionConfig, context: OdometryContext) -> FusionService:
    """Build the service with its topics, for the catalog."""
    bus, inputs = context.bus, context.inputs()
    imu = context.inertial(config.imu)
    # 16: maximum number of queued motions between scans
    return FusionService(
        Fusion(config, context.chassis, None if imu is None else imu.inertial),
        context.clock,
        imu=imu,
        scans=bus.subscribe(topics.SCAN_MOTION, fifo(16)) if context.slam and config.scans is not None else None,
        health=bus.publisher(topics.FUSION, topics.Writer.ESTIMATION),
        events=bus.event_sink(),
        rate=config.rate,
        **inputs,
    )
