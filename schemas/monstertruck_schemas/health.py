"""Messages of the ``health`` group."""

from enum import StrEnum
from typing import Annotated, Final, Literal

from pydantic import Field

from monstertruck_schemas.base import Message, Nanoseconds, Schema
from monstertruck_schemas.reasons import Reason


class ServiceState(StrEnum):
    """Life of a supervised service."""

    STARTING = "starting"
    READY = "ready"
    BACKOFF = "backoff"
    FAILED = "failed"
    STOPPED = "stopped"


class ServiceHealth(Schema):
    """One row of the health table."""

    name: str
    """Name of the service."""
    state: ServiceState
    """State of the service."""
    since: Nanoseconds
    """Time of the last change of the state."""
    restarts: Annotated[int, Field(ge=0)] = 0
    """Restarts since the daemon's start."""
    reason: Reason = Reason.OK
    """Reason of the state."""
    detail: str = ""
    """Last error in words; empty when there was none."""


class HealthTable(Message):
    """Health of every service; published on change and once a second."""

    services: tuple[ServiceHealth, ...]


class CalibrationState(Schema):
    """Calibration by one wizard: value, quality and expiry."""

    wizard: str
    """Wizard that measured it."""
    grade: Literal["A", "B", "C"]
    """Grade by the width of its intervals: A within the goal, B at most twice as wide, C wider."""
    date: str
    """Date of the latest measurement, UTC."""
    until: str
    """Last valid day, UTC."""
    metres_left: float | None = None
    """Distance that may be driven until it expires, m; None: not limited."""
    expired: str = ""
    """Reason for its expiry; empty while it is valid."""


class CalibrationHealth(Message):
    """The calibration that the daemon runs on; published on change and once a minute."""

    wizards: tuple[CalibrationState, ...] = ()
    odometer: float = 0.0
    """Total distance driven, m."""
    proposed: str = ""
    """Calibration proposed by a tracker and not accepted yet, as a sentence; empty if none."""


class LoopHealth(Message):
    """Punctuality of the control tick over the last second and since the start."""

    ticks: int
    """Number of ticks behind the figures."""
    lateness_p50: float
    """Seconds late against the 50 Hz schedule."""
    lateness_p99: float
    """99th percentile of the ticks' lateness, s."""
    lateness_max: float
    """Maximum lateness of a tick, s."""
    drops: int = 0
    """Messages lost in bounded queues since the start."""

    @property
    def busy(self) -> str:
        """That the daemon gets too little processor time, in words; empty while ticks are less than 20 ms late."""
        if self.lateness_p99 <= 0.02:  # threshold of a late control tick, s: a whole period
            return ""
        return f"the computer is busy: control ticks come {self.lateness_p99 * 1e3:.0f} ms late; end other programs"


class RecorderHealth(Message):
    """Recorder status."""

    recording: bool
    """Whether messages are written now."""
    path: str | None = None
    """Current log file; None if there is none."""
    bytes_written: int = 0
    """Bytes of messages since the start."""
    messages: int = 0
    """Messages since the start."""
    drops: int = 0
    """Messages that are not in the log since the start."""
    reason: Reason = Reason.OK
    """Why recording has stopped; OK while it has not."""

    @property
    def lost(self) -> str:
        """That a recording has gaps, in words; empty for one that has none, or has ended."""
        if not (self.recording and self.drops):
            return ""
        return f"{self.drops} messages are missing in the log: the disk takes them too slowly"


class LocalisationStatus(StrEnum):
    """How much the pose in map is worth."""

    MAPPING = "mapping"
    """The scans fit the map that grows with them."""
    LOCALISED = "localised"
    """The scans fit the saved map."""
    DEGENERATE = "degenerate"
    """Scans fit, but do not determine one direction, in which the pose is odometry."""
    UNCERTAIN = "uncertain"
    """The pose in map is less certain than ``UNCERTAIN_DEVIATION``; see its covariance."""
    LOST = "lost"
    """Scans have not fitted for a while: the pose is odometry."""
    SEARCHING = "searching"
    """The position on the saved map is being searched for; the pose is meaningless."""
    OUTSIDE = "outside"
    """Scans match no place on the saved map: the robot is outside it. The search continues."""


UNCERTAIN_DEVIATION: Final = 0.1
"""Standard deviation of the position in map beyond which it is uncertain, m: as far as robots keep from
obstacles."""
PLACELESS: Final = frozenset({LocalisationStatus.SEARCHING, LocalisationStatus.OUTSIDE})
"""States whose pose in map is meaningless."""
MATCHED: Final = frozenset(LocalisationStatus) - PLACELESS - {LocalisationStatus.LOST}
"""States in which the robot is on the map."""
NO_PLACE: Final = PLACELESS | {LocalisationStatus.LOST}
"""States whose pose must not be used for places."""


class OdometryUse(StrEnum):
    """Whether SLAM predicts the motion between scans by odometry."""

    NONE = "none"
    """There is no odometry: scans alone."""
    USED = "used"
    MISSING = "missing"
    """No finite odometry at the scans for a second: scans alone."""
    CONTRADICTED = "contradicted"
    """Scans contradict it: scans alone, until both agree again."""


class SlamHealth(Message):
    """Fit of the latest scan to the map, and counts since the start."""

    standing: LocalisationStatus
    """Status of the localisation."""
    accepted: bool
    """Whether the scan corrected the pose; otherwise odometry alone moved it."""
    overlap: Annotated[float, Field(ge=0, le=1)]
    """Share of the scan's points that fit the map."""
    residual: Annotated[float, Field(ge=0)]
    """Root mean square distance of those across the surfaces, m."""
    degeneracy: Annotated[float, Field(ge=0)]
    """Ratio of the eigenvalues of the scan's position information, smaller over larger; near 0 in a corridor."""
    direction: float
    """Yaw in map along which it knows least, rad."""
    scans: Annotated[int, Field(ge=0)] = 0
    """Scans taken in."""
    keys: Annotated[int, Field(ge=0)] = 0
    """Scans the map is made of."""
    closures: Annotated[int, Field(ge=0)] = 0
    """Loops closed."""
    rejected: Annotated[int, Field(ge=0)] = 0
    """Rejected matches."""
    left_out: Annotated[int, Field(ge=0)] = 0
    """Scans that were too tilted, empty, late or of another geometry."""
    drops: Annotated[int, Field(ge=0)] = 0
    """Scans lost because the worker was too slow."""
    offset: float | None = None
    """Lead of odometry over the scans (s), if significant."""
    odometry: OdometryUse = OdometryUse.NONE
    """Use of odometry by the mapper."""


class OdometryHealth(Message):
    """Sensors available to odometry of ``kind: fusion``; published on change and once a second."""

    slipping: bool
    """The wheels do not hold the ground: they hardly count."""
    disturbed: bool
    """Headings are left out: something magnetic is near."""
    sources: tuple[str, ...]
    """Sensors of the last second."""
    north: float | None = None
    """Yaw in odom of the compass's zero, rad; None until it was found."""
    trim: float = 0.0
    """Estimated error of the wheels' curvature, rad/m."""
    left_out: Annotated[int, Field(ge=0)] = 0
    """Readings that could not be used: late, twice, out of order, impossible or no number."""
    waiting: Annotated[int, Field(ge=0)] = 0
    """Readings queued to be fused again, after a late reading or the onset of a doubt."""


class LinkMedium(StrEnum):
    """Kind of network interface."""

    WIFI = "wifi"
    ETHERNET = "ethernet"


class LinkLevel(StrEnum):
    """Judgement of a network link, with hysteresis; a connected cable is excellent."""

    EXCELLENT = "excellent"
    GOOD = "good"
    FAIR = "fair"
    POOR = "poor"
    UNUSABLE = "unusable"
    DOWN = "down"
    UNKNOWN = "unknown"
    """Connected by Wi-Fi, but the kernel does not report the signal."""


class LinkHealth(Message):
    """Quality of the network link; that a station is lost shows by its silence, never here."""

    interface: str | None = None
    """Checked interface, or None."""
    medium: LinkMedium | None = None
    """Medium of the link."""
    level: LinkLevel
    """Judgement of the link."""
    signal: float | None = None
    """Smoothed signal level, dBm; None on a cable or while disconnected."""
    raw_signal: float | None = None
    """Latest sample (dBm)."""
    noise: float | None = None
    """Noise level, dBm, where the driver knows it."""
    bit_rate: float | None = None
    """Negotiated rate of a cable, bit/s."""
    receive_rate: float | None = None
    """Payload since the last message, byte/s."""
    send_rate: float | None = None
    """As ``receive_rate``."""
    errors: Annotated[int, Field(ge=0)] = 0
    """Damaged or dropped packets of both directions since the interface came up."""


class HostHealth(Message):
    """State of the daemon's computer; None if not available."""

    load: float
    """Mean number of runnable processes over the last minute."""
    cores: Annotated[int, Field(ge=1)]
    """Number of cores."""
    cpu: float | None = None
    """Busy share of all cores since the last message, 0..1."""
    temperature: float | None = None
    """Hottest thermal zone, degree Celsius."""
    frequency: float | None = None
    """Present clock of the fastest core, Hz."""
    frequency_share: float | None = None
    """Currently permitted maximum clock of the cores, as a fraction of their maximum, 0..1."""
    throttled: bool = False
    """Slowed down because of heat or supply voltage, now."""
    memory_total: Annotated[int, Field(ge=0)]
    """Bytes."""
    memory_available: Annotated[int, Field(ge=0)]
    """Bytes that can be had without swapping."""
    disk_total: Annotated[int, Field(ge=0)]
    """Bytes of the file system logs are written to."""
    disk_free: Annotated[int, Field(ge=0)]
    """Bytes of it that are free for the daemon."""
    daemon_memory: Annotated[int, Field(ge=0)]
    """Resident bytes of the daemon itself."""
    daemon_files: Annotated[int, Field(ge=0)]
    """File descriptors the daemon has open."""
