"""One enum of reason codes, shared by gate, services, RPC, events and CLI exit codes.

Members are only ever added; a value is never reused, and exit codes stay below 126. All of them are in use: a new
failure gets the exit code of the closest broader failure. Plug-ins use the existing members.
"""

from collections.abc import Iterable
from enum import StrEnum
from typing import Self


class Reason(StrEnum):
    """Reason of an event, a refusal or an end; ``exit_code`` is the exit code of the command line."""

    exit_code: int
    text: str

    def __new__(cls, value: str, exit_code: int, text: str) -> Self:
        """Build a member from its wire value, exit code and one-line explanation."""
        member = str.__new__(cls, value)
        member._value_ = value
        member.exit_code = exit_code
        member.text = text
        return member

    # Outcomes
    OK = "ok", 0, "done"
    INTERNAL = "internal", 1, "a bug: see the log"
    BAD_CONFIG = "bad_config", 2, "configuration refused"
    BAD_INPUT = "bad_input", 3, "input refused"
    NOT_FOUND = "not_found", 4, "no such file, key or robot"
    TIMEOUT = "timeout", 5, "no answer in time"
    CANCELLED = "cancelled", 6, "ended by the user"
    GOAL_REACHED = "goal_reached", 0, "path driven to its end"
    BUSY = "busy", 7, "in use by another process or caller"
    DISK_FULL = "disk_full", 8, "no space left to record"
    LOG_DAMAGED = "log_damaged", 9, "log is truncated or damaged"
    RECORDING_FAILED = "recording_failed", 10, "a log or another file cannot be written"
    NOT_SUPPORTED = "not_supported", 11, "the robot does not support this"
    NOT_PERMITTED = "not_permitted", 12, "the user lacks the permission"
    NOT_INSTALLED = "not_installed", 13, "a program or package is missing or damaged"
    COMMAND_FAILED = "command_failed", 14, "a program of the computer failed"
    FILE_DAMAGED = "file_damaged", 19, "a file of the robot is damaged and not used"
    REPLAY_DIFFERS = "replay_differs", 15, "outputs recomputed from the log differ from the recorded ones"
    ACKNOWLEDGED = "acknowledged", 0, "an operator has seen a warning"
    RECORDING_DELETED = "recording_deleted", 0, "a recording was deleted"
    SETTING_CHANGED = "setting_changed", 0, "a setting was changed while the robot runs"
    BLACK_BOX_SAVED = "black_box_saved", 0, "the minute before a stop was saved"

    # Devices
    DEVICE_LOST = "device_lost", 20, "device unplugged or its port disappeared"
    DEVICE_TIMEOUT = "device_timeout", 21, "device does not answer"
    DEVICE_PROTOCOL = "device_protocol", 22, "device violates its protocol"
    DEVICE_WRONG = "device_wrong", 23, "another device answers on this port"
    DEVICE_FAULT = "device_fault", 24, "device reports an internal fault"
    DEVICE_MISMATCH = "device_mismatch", 25, "device's parameters differ from the configuration"
    DEVICE_BUSY = "device_busy", 26, "port is held by another process"
    DEVICE_RESTARTED = "device_restarted", 27, "device restarted by itself: it lost its supply"
    DEVICE_STOPPED = "device_stopped", 28, "drive stopped by the deadman line or another master"
    DEVICE_READY = "device_ready", 0, "device is up"

    # Gate
    DISARMED = "disarmed", 40, "the robot is disarmed"
    ESTOPPED = "estopped", 41, "emergency stop is latched"
    ESTOP_REQUESTED = "estop_requested", 42, "emergency stop was requested"
    LEASE_EXPIRED = "lease_expired", 43, "no fresh drive request within its lease"
    LOWER_PRIORITY = "lower_priority", 44, "a source of higher priority is driving"
    BAD_NONCE = "bad_nonce", 45, "request belongs to an earlier run of the robot"
    BAD_SEQUENCE = "bad_sequence", 46, "request is older than one already received"
    BAD_ROLE = "bad_role", 47, "this role may not make this request"
    NOT_FINITE = "not_finite", 48, "request contains NaN or infinity"
    SCAN_STALE = "scan_stale", 49, "no fresh lidar scan"
    DRIVE_STALE = "drive_stale", 50, "no fresh drive feedback"
    STEERING_STALE = "steering_stale", 51, "no fresh steering feedback"
    ATTITUDE_STALE = "attitude_stale", 52, "no fresh attitude"
    TILT_SLOW = "tilt_slow", 53, "tilted: speed limited"
    TILT_STOP = "tilt_stop", 54, "dangerous tilt"
    OBSTACLE_SLOW = "obstacle_slow", 55, "obstacle ahead: speed limited"
    OBSTACLE_STOP = "obstacle_stop", 56, "obstacle within the stopping distance"
    KEEPOUT = "keepout", 56, "a keepout zone is ahead, or the robot is in one"
    ZONE_SLOW = "zone_slow", 0, "speed zone: speed limited"
    BATTERY_LOW = "battery_low", 57, "battery low: speed limited"
    BATTERY_CRITICAL = "battery_critical", 58, "battery critical"
    BATTERY_STALE = "battery_stale", 59, "no fresh battery voltage"
    CLIPPED = "clipped", 60, "request beyond the limits, clipped to the nearest possible motion"
    TICK_STALLED = "tick_stalled", 61, "the control tick came too late"
    DRIVE_FAULT = "drive_fault", 62, "drive controller is in fault"
    SERVICE_FAILED = "service_failed", 63, "a service failed"
    NOT_ARMED_SPEED = "not_armed_speed", 64, "the robot or the stick is not at rest"
    SHUTDOWN = "shutdown", 65, "the daemon is stopping"
    STEERING_DEAD = "steering_dead", 66, "the robot does not turn as steered"
    IMPOSSIBLE_MOTION = "impossible_motion", 67, "the body cannot make this motion"
    SERVO_LIMIT = "servo_limit", 68, "a steering servo is at the end of its range: less steering than requested"
    ASSISTED = "assisted", 0, "assisted driving steers around an obstacle"
    LIDAR_SLOW = "lidar_slow", 70, "the lidar does not see the direction of travel: speed limited"
    LIDAR_BLIND = "lidar_blind", 71, "the lidar has not seen the direction of travel for too long"
    UNSEEN_SLOW = "unseen_slow", 76, "ground that no scan has seen recently: speed limited"
    UNSEEN_STOP = (
        "unseen_stop",
        16,
        "ground ahead that no sensor has seen recently: hold the second control to drive on",
    )
    UNSEEN_DRIVE = "unseen_drive", 17, "driving into unseen ground"
    CONTACT = "contact", 0, "touched an unseen obstacle: backs off and waits for another direction"
    SONAR_STALE = "sonar_stale", 78, "no fresh ranges of the sonars"
    SONAR_BLIND = "sonar_blind", 79, "the sonar facing the direction of travel does not answer"
    SONAR_SLOW = "sonar_slow", 69, "no sonar covers the whole direction of travel: speed limited"
    OWN_CHECK = "own_check", 18, "a check added by the configuration refuses the motion"
    PEER_UNKNOWN = "peer_unknown", 74, "the position of another robot is unknown: speed limited"
    SHAFT_BLOCKED = "shaft_blocked", 72, "a driven shaft does not turn as commanded"
    FAULTS_REPEAT = "faults_repeat", 73, "short faults repeat"
    UNCOMMANDED_MOTION = "uncommanded_motion", 75, "a motor turns without a command"
    WEAKENED = "weakened", 77, "configured less safely than by default"
    ARMED = "armed", 0, "armed"
    DRIVE_ASKED = "drive_asked", 0, "an operator requests control"
    DRIVE_HANDED = "drive_handed", 0, "an operator handed over control"
    DRIVING = "driving", 0, "driving"
    STOPPED = "stopped", 0, "at standstill"

    # Services and workers
    WORKER_TIMEOUT = "worker_timeout", 80, "worker missed its deadline and was killed"
    WORKER_DIED = "worker_died", 81, "worker process ended by itself"
    CLOCK_STEPPED = "clock_stepped", 82, "real time was stepped"
    MESSAGES_DROPPED = "messages_dropped", 83, "a bounded queue overflowed"
    PATH_LOST = "path_lost", 84, "the robot is too far from its path"
    CUSP_MISSED = "cusp_missed", 85, "the robot stopped too far from a direction change of its path"
    RESPONSE_DIFFERS = "response_differs", 86, "the axles respond later or sooner than configured"
    CLOCK_DRIFT = "clock_drift", 87, "the clocks of a sensor and the computer drift apart"
    CALIBRATION_EXPIRED = "calibration_expired", 88, "a calibration has expired: measure it again"
    RESPONSE_AGREES = "response_agrees", 0, "the axles respond as configured again"
    STEERING_DIFFERS = "steering_differs", 0, "an axle steers more, less or further to a side than calibrated, or slips"
    STEERING_AGREES = "steering_agrees", 0, "the axles steer as calibrated again"

    # Localisation and mapping
    POSE_LOST = "pose_lost", 90, "the scans do not fit the map: the pose is odometry alone"
    MATCH_DEGENERATE = "match_degenerate", 91, "the scans say nothing along one direction"
    TIME_OFFSET = "time_offset", 92, "odometry and scans are stamped by clocks that disagree"
    LIDAR_TURNED = "lidar_turned", 92, "the lidar is turned relative to its configured mount, or upside down"
    SCAN_LEFT_OUT = "scan_left_out", 93, "a scan cannot be used"
    WHEEL_SLIP = (
        "wheel_slip",
        94,
        "the driven wheels slip: other sensors measure another motion",
    )
    HEADING_DISTURBED = "heading_disturbed", 95, "the compass is disturbed: its headings are left out"
    IMU_DISAGREES = "imu_disagrees", 99, "the IMU and the wheels measure different turns"
    SENSORS_DISAGREE = "sensors_disagree", 125, "two sensors report conflicting motion"
    SENSOR_FROZEN = "sensor_frozen", 108, "a sensor repeats identical values"
    UNWITNESSED = "unwitnessed", 109, "no second sensor measures the robot's motion: speed limited"
    SENSORS_AGREE = "sensors_agree", 0, "the sensors agree again"
    ENCODERS_DISAGREE = "encoders_disagree", 89, "an encoder of the rear wheels reports an impossible motion"
    MAP_CHANGED = "map_changed", 97, "what the map shows around the robot is gone"
    OUTSIDE_MAP = "outside_map", 97, "the scans match no place on the saved map"
    WHEEL_GRIP = "wheel_grip", 0, "the wheels grip again"
    IMU_AGREES = "imu_agrees", 0, "the yaw rate of the IMU is used again"
    ENCODERS_AGREE = "encoders_agree", 0, "the encoders of the rear wheels are used again"
    HEADING_RETURNED = "heading_returned", 0, "the headings of the compass are used again"
    POSE_FOUND = "pose_found", 0, "the scans fit the map again"
    ODOMETRY_DROPPED = "odometry_dropped", 96, "scans contradict odometry, or it is missing: mapping uses scans alone"
    ODOMETRY_RETURNED = "odometry_returned", 0, "odometry agrees with the scans again: mapping uses it"
    LOOP_CLOSED = "loop_closed", 0, "a place was recognised and the map corrected"
    JOIN_UNDONE = "join_undone", 0, "a wrong join of two map parts was undone"
    MAP_SAVED = "map_saved", 0, "the map was saved"
    MAP_NOT_SAVED = "map_not_saved", 0, "the map could not be saved"

    # USB
    HUB_LOST = "hub_lost", 100, "a USB hub disappeared with all devices behind it"
    HUB_RETURNED = "hub_returned", 0, "a USB hub is back, its devices start in turn"
    OVER_CURRENT = "over_current", 101, "a USB port drew too much current"
    AUTOSUSPEND = "autosuspend", 102, "the kernel may suspend a USB device in use"
    PORT_MOVED = "port_moved", 103, "a device was plugged into another port than configured"
    SLOW_LINK = "slow_link", 104, "a device's link is slow"
    PORT_CYCLED = "port_cycled", 105, "a USB port was switched off and on"
    PORT_OFF = "port_off", 107, "a USB port was switched off to stop a motor"
    DEVICE_WEDGED = "device_wedged", 106, "device accepts no bytes, or the kernel cannot open or close its port"

    # The truck's supply, host and network
    BATTERY_OVERCHARGED = "battery_overcharged", 110, "battery voltage above the limit of a full pack"
    HOST_HOT = "host_hot", 111, "the computer is hot"
    HOST_THROTTLED = "host_throttled", 112, "the processor is throttled"
    DISK_LOW = "disk_low", 113, "little disk space left"
    MEMORY_LOW = "memory_low", 114, "little memory left"
    HOST_BUSY = "host_busy", 115, "the processor is close to full load"
    LINK_WEAK = "link_weak", 116, "network link is weak"
    LINK_DOWN = "link_down", 117, "no network link"
    CLOCK_UNSET = "clock_unset", 118, "the computer does not know the time"
    LINK_OPEN = "link_open", 119, "any program on the network may drive the robot"

    # Routes
    PLANNER_STARTING = "planner_starting", 29, "the planner is starting"
    START_BLOCKED = "start_blocked", 30, "the robot stands in an obstacle or off the map"
    GOAL_BLOCKED = "goal_blocked", 31, "the robot would stand in an obstacle at the goal"
    GOAL_OUTSIDE = "goal_outside", 32, "the goal is off the map"
    GOAL_UNREACHABLE = "goal_unreachable", 33, "no route to the goal"
    ROUTE_TIMEOUT = "route_timeout", 34, "no route found in the time allowed"
    PATH_BLOCKED = "path_blocked", 35, "an obstacle blocks the route and no way around it is near"
    PATH_PARTIAL = "path_partial", 0, "only the beginning of the path is free"

    # Goals
    GOAL_MISSED = "goal_missed", 36, "the robot stopped away from its goal"
    GOAL_TIMEOUT = "goal_timeout", 37, "goal not reached in the time allowed"
    STUCK = "stuck", 38, "the robot makes no progress"
    NO_MAP = "no_map", 39, "no map or no pose to plan with yet"
    GOAL_ACCEPTED = "goal_accepted", 0, "a goal was accepted"
    ROUTE_FOUND = "route_found", 0, "a route was planned"
    ROUTE_DEFORMED = "route_deformed", 0, "the path goes around an obstacle on the route"
    YIELDS = "yields", 0, "the robot lets a person pass"
    ROUTE_FREE = "route_free", 0, "the robot drives the planned route again"
    WAYPOINT_PASSED = "waypoint_passed", 0, "a waypoint on the way to the goal was passed"
    RECOVERING = "recovering", 0, "a recovery is in progress"
    PAUSED = "paused", 0, "the drive to the goal is paused"
    RESUMED = "resumed", 0, "the drive to the goal continues"

    # Behaviours
    INPUT_STALE = "input_stale", 120, "a behaviour has no fresh input"
    INPUT_CONTRADICTORY = "input_contradictory", 121, "the inputs of a behaviour contradict each other"
    NOT_OBEYED = "not_obeyed", 122, "the gate does not carry out a behaviour's requests"
    BEHAVIOUR_STARTED = "behaviour_started", 0, "a behaviour was started"
    BEHAVIOUR_DONE = "behaviour_done", 0, "a behaviour is complete"

    # Docking
    DOCK_NOT_SEEN = "dock_not_seen", 120, "the camera does not see the tag of the dock"
    DOCK_MISSED = "dock_missed", 36, "the robot stopped next to the dock"
    NOT_CHARGING = "not_charging", 98, "the robot stands at the dock, but its battery is not charged"
    DOCKING = "docking", 0, "the robot drives slowly near a dock"

    # Exploration
    CHARGE_SPENT = "charge_spent", 123, "the remaining charge is reserved for the drive home"
    EXPLORATION_STARTED = "exploration_started", 0, "an exploration was started"
    FRONTIER_CHOSEN = "frontier_chosen", 0, "the exploration chose another frontier"
    EXPLORED = "explored", 0, "nothing is left to explore"
    POINT_FOUND = "point_found", 0, "the camera found a point of interest"
    POINT_CHANGED = "point_changed", 0, "an operator marked or removed a point of interest"
    POINTS_FOUND = "points_found", 0, "the requested number of points of interest was found"
    ZONE_CHANGED = "zone_changed", 0, "an operator added or removed a zone"
    ZONE_OFF = "zone_off", 0, "an operator turned a zone off for a while"
    ZONE_ON = "zone_on", 0, "a zone is in force again"
    ZONE_ENTERED = "zone_entered", 0, "the robot entered a zone"
    ZONE_LEFT = "zone_left", 0, "the robot left a zone"
    MISSION_STARTED = "mission_started", 0, "a mission was started"
    MISSION_STEP = "mission_step", 0, "a step of a mission begins"
    MISSION_NOTE = "mission_note", 0, "a note written to the log by a mission"
    MISSION_DONE = "mission_done", 0, "all steps of the mission are done"
    MISSION_INCOMPLETE = "mission_incomplete", 124, "steps of the mission have failed"
    BUDGET_SPENT = "budget_spent", 0, "the time limit of the exploration is reached"


def in_words(reasons: Iterable[Reason]) -> str:
    """Texts of all ``reasons``, in their order."""
    return ", ".join(reason.text for reason in reasons)
