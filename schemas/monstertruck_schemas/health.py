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
    """Last error in words; empty without an error."""


class HealthTable(Message):
    """Health of every service; published on change and once a second."""

    services: tuple[ServiceHealth, ...]


class CalibrationState(Schema):
    """Result of one calibration wizard: value, quality and expiry."""

    wizard: str
    """Wizard that measured it."""
    grade: Literal["A", "B", "C"]
    """Grade by the width of its intervals: A within the goal, B at most twice as wide, C wider."""
    date: str
    """Date of the latest measurement, UTC."""
    until: str
    """Last valid day, UTC."""
    metres_left: float | None = None
    """Remaining distance until it expires, m; None: unlimited."""
    expired: str = ""
    """Reason for its expiry; empty while it is valid."""


class CalibrationHealth(Message):
    """Calibration used by the daemon; published on change and once a minute."""

    wizards: tuple[CalibrationState, ...] = ()
    odometer: float = 0.0
    """Total distance driven, m."""
    proposed: str = ""
    """Calibration proposed by a tracker and not yet accepted, as a sentence; empty if none."""


class LoopHealth(Message):
    """Punctuality of the control tick over the last second and since the start."""

    ticks: int
    """Number of ticks behind the figures."""
    lateness_p50: float
    """Lateness against the 50 Hz schedule, s."""
    lateness_p99: float
    """99th percentile of the ticks' lateness, s."""
    lateness_max: float
    """Maximum lateness of a tick, s."""
    drops: int = 0
    """Number of messages lost in bounded queues since the start."""

    @property
    def busy(self) -> str:
        """Warning that the daemon gets too little processor time; empty while ticks are less than 20 ms late."""
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
    """Number of messages missing in the log since the start."""
    reason: Reason = Reason.OK
    """Why recording has stopped; OK while it has not."""

    @property
    def lost(self) -> str:
        """Warning that a recording has gaps; empty for a complete or ended one."""
        if not (self.recording and self.drops):
            return ""
        return f"{self.drops} messages are missing in the log: the disk takes them too slowly"


class LocalisationStatus(StrEnum):
    """Reliability of the pose in map."""

    MAPPING = "mapping"
    """The scans fit the map being built."""
    LOCALISED = "localised"
    """The scans fit the saved map."""
    DEGENERATE = "degenerate"
    """Scans fit, but do not constrain one direction, in which the pose is odometry."""
    UNCERTAIN = "uncertain"
    """The pose in map is less certain than ``UNCERTAIN_DEVIATION``; see its covariance."""
    LOST = "lost"
    """Scans have not fitted for a while: the pose is odometry."""
    SEARCHING = "searching"
    """Localisation is searching for the pose on the saved map; the pose is meaningless."""
    OUTSIDE = "outside"
    """Scans match no place in the saved map: the robot is outside it. The search continues."""


UNCERTAIN_DEVIATION: Final = 0.1
"""Standard deviation of the position in map above which it is uncertain, m: the usual clearance to obstacles."""
PLACELESS: Final = frozenset({LocalisationStatus.SEARCHING, LocalisationStatus.OUTSIDE})
"""States whose pose in map is meaningless."""
MATCHED: Final = frozenset(LocalisationStatus) - PLACELESS - {LocalisationStatus.LOST}
"""States in which the robot is on the map."""
NO_PLACE: Final = PLACELESS | {LocalisationStatus.LOST}
"""States in which the pose must not be used as a place."""


class OdometryUse(StrEnum):
    """Whether SLAM predicts the motion between scans by odometry."""

    NONE = "none"
    """No odometry: scans only."""
    USED = "used"
    MISSING = "missing"
    """No finite odometry at the times of the scans for a second: scans only."""
    CONTRADICTED = "contradicted"
    """Scans contradict odometry: scans only, until both agree again."""


class SlamHealth(Message):
    """Fit of the latest scan to the map, and counts since the start."""

    standing: LocalisationStatus
    """Status of the localisation."""
    accepted: bool
    """Whether the scan corrected the pose; otherwise it followed odometry."""
    overlap: Annotated[float, Field(ge=0, le=1)]
    """Fraction of the scan's points that fit the map."""
    residual: Annotated[float, Field(ge=0)]
    """Root mean square distance of these points from the surfaces, m."""
    degeneracy: Annotated[float, Field(ge=0)]
    """Ratio of the eigenvalues of the scan's position information, smaller over larger; near 0 in a corridor."""
    direction: float
    """Least constrained direction, as a yaw in map, rad."""
    scans: Annotated[int, Field(ge=0)] = 0
    """Number of processed scans."""
    keys: Annotated[int, Field(ge=0)] = 0
    """Number of keyframes in the map."""
    closures: Annotated[int, Field(ge=0)] = 0
    """Number of loops closed."""
    rejected: Annotated[int, Field(ge=0)] = 0
    """Number of rejected matches."""
    left_out: Annotated[int, Field(ge=0)] = 0
    """Number of unusable scans: too tilted, empty, late or of another geometry."""
    drops: Annotated[int, Field(ge=0)] = 0
    """Number of scans lost because the worker was too slow."""
    offset: float | None = None
    """Lead of odometry over the scans (s), if significant."""
    odometry: OdometryUse = OdometryUse.NONE
    """Use of odometry by the mapper."""


class OdometryHealth(Message):
    """Sensors available to odometry of ``kind: fusion``; published on change and once a second."""

    slipping: bool
    """The wheels slip and are almost ignored."""
    disturbed: bool
    """The compass is disturbed and its headings are ignored."""
    sources: tuple[str, ...]
    """Sensors used in the last second."""
    north: float | None = None
    """Yaw of the compass's zero in odom, rad; None until it is found."""
    trim: float = 0.0
    """Estimated error of the wheels' curvature, rad/m."""
    left_out: Annotated[int, Field(ge=0)] = 0
    """Number of unusable readings: late, repeated, out of order, impossible or not finite."""
    waiting: Annotated[int, Field(ge=0)] = 0
    """Number of readings to be fused again, after a late reading or the onset of a doubt."""


class LinkMedium(StrEnum):
    """Kind of network interface."""

    WIFI = "wifi"
    ETHERNET = "ethernet"


class LinkLevel(StrEnum):
    """Rating of a network link, with hysteresis; a connected cable is excellent."""

    EXCELLENT = "excellent"
    GOOD = "good"
    FAIR = "fair"
    POOR = "poor"
    UNUSABLE = "unusable"
    DOWN = "down"
    UNKNOWN = "unknown"
    """Connected by Wi-Fi, but the kernel does not report the signal."""


class LinkHealth(Message):
    """Quality of the network link. Silence, not this message, shows that a station has lost the link."""

    interface: str | None = None
    """Checked interface; None if there is none."""
    medium: LinkMedium | None = None
    """Medium of the link."""
    level: LinkLevel
    """Judgement of the link."""
    signal: float | None = None
    """Smoothed signal level, dBm; None on a cable or while disconnected."""
    raw_signal: float | None = None
    """Latest sample (dBm)."""
    noise: float | None = None
    """Noise level, dBm, if the driver reports it."""
    bit_rate: float | None = None
    """Negotiated rate of a cable, bit/s."""
    receive_rate: float | None = None
    """Payload received since the last message, byte/s."""
    send_rate: float | None = None
    """Payload sent since the last message, byte/s."""
    errors: Annotated[int, Field(ge=0)] = 0
    """Number of damaged or dropped packets in both directions since the interface came up."""


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
    """Current clock of the fastest core, Hz."""
    frequency_share: float | None = None
    """Currently permitted maximum clock of the cores, as a fraction of their maximum, 0..1."""
    throttled: bool = False
    """Whether heat or supply voltage currently slows the processor down."""
    memory_total: Annotated[int, Field(ge=0)]
    """Total memory, bytes."""
    memory_available: Annotated[int, Field(ge=0)]
    """Memory available without swapping, bytes."""
    disk_total: Annotated[int, Field(ge=0)]
    """Size of the file system of the logs, bytes."""
    disk_free: Annotated[int, Field(ge=0)]
    """Free space on it for the daemon, bytes."""
    daemon_memory: Annotated[int, Field(ge=0)]
    """Resident memory of the daemon, bytes."""
    daemon_files: Annotated[int, Field(ge=0)]
    """Number of open file descriptors of the daemon."""
