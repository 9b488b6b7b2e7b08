"""What to do when ...: the reasons of events, stops and refusals, by what a person sees of them."""

from typing import Final, NamedTuple

from monstertruck_schemas.reasons import Reason
from pages.markdown import Page, cell, join, table


class Symptom(NamedTuple):
    """What is seen, what to do first, and the reasons that are behind it."""

    seen: str
    first: str
    reasons: dict[str, str]
    """By name: what to do about this one; empty: the first word on the symptom says it."""


SYMPTOMS: Final = (
    Symptom(
        "It does not arm, or does not move",
        "`monstertruckd status` names every reason that holds it; `monstertruckd doctor` looks at the computer.",
        {
            "disarmed": "`monstertruckd arm`.",
            "estopped": "Who stopped it, and why (`status`, black box)? Then `monstertruckd reset`, and arm.",
            "estop_requested": "As above.",
            "not_armed_speed": "Let go of the stick, wait until it stands, and arm again.",
            "lower_priority": "Somebody with precedence drives: wait, or ask for it.",
            "lease_expired": "The link to who drives broke: go nearer, or use the cable.",
            "bad_nonce": "The daemon was restarted: start the client again.",
            "bad_sequence": "Two programs use one name: give each its own.",
            "bad_role": "The certificate does not allow that: `monstertruckd security`.",
            "not_permitted": "As above; for a file or device see `monstertruckd doctor`.",
            "not_finite": "The program that drives sends no numbers: mend it.",
            "impossible_motion": "This body cannot move like that: see the page on robots.",
            "servo_limit": "It asks for more than the servos' travel: calibrate the steering.",
            "not_supported": "",
            "busy": "Another program uses it: end that one.",
            "shutdown": "The daemon is ending: `systemctl status monstertruckd`.",
            "service_failed": "`status` names the service and its last error.",
            "weakened": "Safety is set weaker than the default; `status` names the setting.",
        },
    ),
    Symptom(
        "It stops, or creeps",
        "Look at what the lidar sees (`status`, the station's page): most stops are right.",
        {
            "obstacle_stop": "Clear the way, or drive back.",
            "obstacle_slow": "",
            "lidar_slow": "Clean the lidar's window; shiny and black walls give no echo.",
            "lidar_blind": "As above; something hangs before it?",
            "unseen_stop": "No sensor has seen the ground there lately: drive forward, or hold the second control.",
            "unseen_drive": "",
            "unseen_slow": "It drives where no sensor looks: turn it round.",
            "sonar_slow": "",
            "own_check": "A check of section `checks` holds it: the event names the check.",
            "peer_unknown": "A robot of `peers` is silent, or this one has no pose: see `echo state/peers`.",
            "sonar_blind": "A sonar does not answer: check its plug.",
            "tilt_slow": "",
            "tilt_stop": "Drive it down by hand, or carry it; `gate.tilt` says from where.",
            "clipped": "It was asked for more than allowed, and does less.",
            "uncommanded_motion": "Switch the motors off by hand. Controller, cable or encoder is broken: "
            "the event names the shaft; `reset` once it is repaired.",
            "shaft_blocked": "A wheel is held: switch off, free it, look at the clutch.",
            "steering_dead": "Loose horn, reversed servo, or iron: `calibrate steering`.",
            "faults_repeat": "A plug is loose: the events before name the device.",
        },
    ),
    Symptom(
        "A device is lost, or wrong",
        "`monstertruckd usb` shows hubs, ports and devices; move the cable and look again.",
        {
            "device_lost": "Plug, cable, hub, in this order.",
            "device_wedged": "Switch it off and on, or replug it; the port is free again after half a minute at most.",
            "device_timeout": "Is it supplied? Is the baud rate right? `monstertruckd probe`.",
            "device_protocol": "As above; long or unshielded cables.",
            "device_wrong": "Two cables were swapped: `monstertruckd find-port`.",
            "device_fault": "Its manual has the code of the event.",
            "device_mismatch": "Its stored parameters differ: the event names them.",
            "device_busy": "Another program holds the port: `monstertruckd doctor`.",
            "device_restarted": "It lost its supply: measure the voltage at its plug while the motor starts.",
            "device_stopped": "The deadman line fell, or a second master commands it.",
            "scan_stale": "Lidar: as for a lost device.",
            "drive_stale": "Drive: as for a lost device.",
            "steering_stale": "Servo controller: as for a lost device.",
            "attitude_stale": "Compass: as for a lost device.",
            "sonar_stale": "Sonars: as for a lost device.",
            "drive_fault": "Its code is in the event; over-current: free the wheels.",
            "hub_lost": "The hub's own plug or supply.",
            "over_current": "Too much hangs on that hub: use a supplied one.",
            "autosuspend": "`monstertruckd install-service` keeps ports awake.",
            "port_moved": "Plug it back, or `monstertruckd find-port`.",
            "slow_link": "A USB 1 cable or hub on the way.",
            "port_off": "Switch the motors off by hand, repair the drive, then `uhubctl -a on`.",
            "port_cycled": "The daemon has switched that port off and on.",
            "clock_drift": "The lidar's clock is wrong: switch it off and on.",
        },
    ),
    Symptom(
        "The battery",
        "Land it first: a LiPo below 3.3 V a cell is damaged.",
        {
            "battery_low": "Drive home.",
            "battery_critical": "Change the pack now.",
            "battery_stale": "Sense wire or divider: `monstertruckd calibrate battery` shows the raw value.",
            "battery_overcharged": "Wrong charger, or wrong scale: measure with a meter before you touch the pack.",
            "charge_spent": "",
        },
    ),
    Symptom(
        "It drives crookedly, or the pose is wrong",
        "`monstertruckd calibrate show`: what was measured, how well, until when.",
        {
            "calibration_expired": "`monstertruckd calibrate all`.",
            "response_differs": "`monstertruckd calibrate steering`.",
            "heading_disturbed": "Iron nearby; at home too: `monstertruckd calibrate compass`.",
            "wheel_slip": "Smooth floor, or a wheel in the air.",
            "encoders_disagree": "Look at the encoder that is named: its disc, its cable, its side.",
            "sensors_disagree": "Look at both sensors that are named: mount, cable, wheels; then arm again.",
            "sensor_frozen": "Replug the sensor that is named.",
            "unwitnessed": "`monstertruckd doctor` says which sensor is missing.",
            "imu_disagrees": "`monstertruckd calibrate imu`; is it screwed down?",
            "time_offset": "`monstertruckd calibrate lidar` prints the offset.",
            "odometry_dropped": "Look at the wheels; calibrate drive and odometry.",
            "witness_disagrees": "",
            "pose_lost": "Drive slowly where much is in sight.",
            "match_degenerate": "A bare corridor: it goes on by odometry.",
            "outside_map": "Another map? `monstertruckd map localise`.",
            "scan_left_out": "Tilted or covered: level the lidar.",
        },
    ),
    Symptom(
        "It does not reach its goal",
        "The answer to `goto` and the journal have the reason.",
        {
            "path_lost": "Start it nearer to its path.",
            "cusp_missed": "",
            "planner_starting": "Wait some seconds.",
            "start_blocked": "Drive it free by hand.",
            "goal_blocked": "Choose another goal.",
            "goal_outside": "",
            "goal_unreachable": "",
            "route_timeout": "",
            "path_blocked": "Clear the way.",
            "goal_missed": "",
            "goal_timeout": "",
            "stuck": "Free it by hand.",
            "no_map": "Give it a map, or `slam`.",
            "input_stale": "",
            "input_contradictory": "",
            "not_obeyed": "Somebody else drives, or the gate holds it.",
            "mission_incomplete": "",
        },
    ),
    Symptom(
        "The computer",
        "`monstertruckd doctor` tells each of these before the drive, with the command that mends it.",
        {
            "host_hot": "Fan and dust.",
            "host_throttled": "Heat, or a weak supply of the computer.",
            "host_busy": "`top`.",
            "memory_low": "",
            "disk_low": "Take the logs off.",
            "disk_full": "As above.",
            "recording_failed": "The card may be worn out: take a new one.",
            "log_damaged": "`monstertruckd log recover`.",
            "file_damaged": "Its values are those of before, or none: see what the event names, then clear the stop.",
            "link_weak": "",
            "link_down": "",
            "link_open": "Anybody can listen: use WPA2, and certificates.",
            "clock_unset": "",
            "clock_stepped": "",
            "tick_stalled": "Something else takes the processor.",
            "messages_dropped": "As above; of the `recorder`, its disk is too slow.",
            "worker_timeout": "As above.",
            "worker_died": "The journal has its last words.",
        },
    ),
    Symptom(
        "A command ends with an error",
        "It says in one line which file, line or key it means, and what was expected.",
        {
            "internal": "A bug: report it with the log.",
            "bad_config": "`monstertruckd config show FILE`.",
            "bad_input": "",
            "not_found": "",
            "timeout": "Is the daemon running? `systemctl status monstertruckd`.",
            "cancelled": "",
            "not_installed": "",
            "command_failed": "",
            "replay_differs": "",
        },
    ),
)


def page() -> Page:
    """The page."""
    texts = {reason.value: reason.text for reason in Reason}
    parts = [
        "# What to do when ...",
        "By what you see: the reason that events, stops and commands name, and what to do.",
    ]
    for symptom in SYMPTOMS:
        rows = [(f"`{name}`", texts[name], todo) for name, todo in symptom.reasons.items()]
        parts += [f"## {symptom.seen}", symptom.first, table(("reason", "what it says", "do"), rows)]
    return Page("what-to-do.md", cell("What to do when ..."), join(*parts))
