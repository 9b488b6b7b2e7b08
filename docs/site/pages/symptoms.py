"""Troubleshooting page: the reasons of events, stops and refusals, by symptom."""

from typing import Final, NamedTuple

from monstertruck_schemas.reasons import Reason
from pages.markdown import Page, cell, join, table


class Symptom(NamedTuple):
    """A symptom, the first step, and the reasons that cause it."""

    seen: str
    first: str
    reasons: dict[str, str]
    """Remedy by reason."""


SYMPTOMS: Final = (
    Symptom(
        "It does not arm, or does not move",
        "`monstertruckd status` lists every active reason; `monstertruckd doctor` checks the computer.",
        {
            "disarmed": "`monstertruckd arm`.",
            "estopped": "Find out who stopped it and why (`status`, black box). Then `monstertruckd reset`, and arm.",
            "estop_requested": "Find out who stopped it (`status`), then `monstertruckd reset`, and arm.",
            "not_armed_speed": "Release the stick, wait for standstill, and arm again.",
            "lower_priority": "A source with higher priority drives: wait, or ask for control.",
            "lease_expired": "The link to the driving client broke: move closer, or use a cable.",
            "bad_nonce": "The daemon restarted: restart the client.",
            "bad_sequence": "Two programs use the same name: give each its own.",
            "bad_role": "The certificate does not permit it: `monstertruckd security`.",
            "not_permitted": "Certificates: `monstertruckd security`; a file or device: `monstertruckd doctor`.",
            "not_finite": "The driving program sends NaN or infinity: fix it.",
            "impossible_motion": "The body cannot make this motion: see the page on robots.",
            "servo_limit": "The request exceeds the servo travel: calibrate the steering.",
            "not_supported": "Choose another command, or add the missing section or device named in the message.",
            "busy": "Another program uses it: stop that program.",
            "shutdown": "The daemon is shutting down: `systemctl status monstertruckd`.",
            "service_failed": "`status` names the service and its last error.",
            "weakened": "A setting is less safe than its default; `status` names it.",
        },
    ),
    Symptom(
        "It stops, or creeps",
        "Check what the lidar sees (`status`, station page): most stops are correct.",
        {
            "obstacle_stop": "Clear the way, or drive back.",
            "obstacle_slow": "Drive on slowly, or clear the way.",
            "lidar_slow": "Clean the lidar's window; shiny and black walls return no echo.",
            "lidar_blind": "Clean the lidar's window and remove covers from its view.",
            "unseen_stop": "No sensor has seen that ground recently: drive forward, or hold the second control.",
            "unseen_drive": "Drive slowly; release the second control to stop.",
            "unseen_slow": "It drives where no sensor looks: turn it around.",
            "sonar_slow": "Turn the robot so that a sonar faces the direction of travel, or add a sonar there.",
            "keepout": "Turn the zone off for a while (`zone off`), or drive back.",
            "own_check": "A check in the section `checks` stops it: the event names the check.",
            "peer_unknown": "A robot in `peers` is silent, or this robot has no pose: see `echo state/peers`.",
            "sonar_blind": "A sonar does not answer: check its plug.",
            "tilt_slow": "Drive to level ground.",
            "tilt_stop": "Drive it to level ground by hand, or carry it; `gate.tilt` has the limit.",
            "clipped": "The request exceeded a limit and was reduced.",
            "uncommanded_motion": "Switch the motors off by hand. Controller, cable or encoder is broken: "
            "the event names the shaft; `reset` once it is repaired.",
            "shaft_blocked": "A wheel is blocked: switch off, free it, check the clutch.",
            "steering_dead": "Loose servo horn, reversed servo, or iron nearby: `calibrate steering`.",
            "faults_repeat": "A plug is loose: the events before name the device.",
        },
    ),
    Symptom(
        "A device is lost, or wrong",
        "`monstertruckd usb` shows hubs, ports and devices; replug the cable and compare.",
        {
            "device_lost": "Plug, cable, hub, in this order.",
            "device_wedged": "Power-cycle or replug it; the port is free again within 30 s.",
            "device_timeout": "Check its supply and baud rate: `monstertruckd probe`.",
            "device_protocol": "Check its baud rate and the shielding and length of its cable: `monstertruckd probe`.",
            "device_wrong": "Two cables are swapped: `monstertruckd find-port`.",
            "device_fault": "Look up the code of the event in its manual.",
            "device_mismatch": "Its stored parameters differ from the configuration: the event names them.",
            "device_busy": "Another program holds the port: `monstertruckd doctor`.",
            "device_restarted": "It lost power: measure the voltage at its plug while the motor starts.",
            "device_stopped": "The deadman line dropped, or another master commands it.",
            "scan_stale": "Lidar: as for `device_lost`.",
            "drive_stale": "Drive: as for `device_lost`.",
            "steering_stale": "Servo controller: as for `device_lost`.",
            "attitude_stale": "Compass: as for `device_lost`.",
            "sonar_stale": "Sonars: as for `device_lost`.",
            "drive_fault": "The event has the code; after over-current, free the wheels.",
            "hub_lost": "Check the hub's plug and supply.",
            "over_current": "The hub is overloaded: use a powered hub.",
            "autosuspend": "`monstertruckd install-service` keeps ports awake.",
            "port_moved": "Move it back to its port, or `monstertruckd find-port`.",
            "slow_link": "Replace the USB 1 cable or hub in the path.",
            "port_off": "Switch the motors off by hand, repair the drive, then `uhubctl -a on`.",
            "port_cycled": "The daemon has power-cycled that port.",
            "clock_drift": "The lidar's clock is wrong: power-cycle the lidar.",
        },
    ),
    Symptom(
        "The battery",
        "Stop driving first: a LiPo below 3.3 V per cell is damaged.",
        {
            "battery_low": "Return to the start.",
            "battery_critical": "Change the pack now.",
            "battery_stale": "Check sense wire and divider: `monstertruckd calibrate battery` shows the raw value.",
            "battery_overcharged": "Wrong charger, or wrong scale: measure with a meter before you touch the pack.",
            "charge_spent": "Charge or change the pack, then start the exploration again.",
        },
    ),
    Symptom(
        "It does not dock",
        "`monstertruckd dock` names the attempt that failed; `plan/behaviour` has the distances.",
        {
            "dock_not_seen": "Light and clean the tag; check its number and size, and the camera's mount.",
            "dock_missed": "Measure the dock's pose and `tag_distance` again; check the floor for slip.",
            "not_charging": "Switch the charger on and clean the contacts; check `docks.NAME.charging`.",
        },
    ),
    Symptom(
        "It drives crookedly, or the pose is wrong",
        "`monstertruckd calibrate show` lists the measurements, their quality and expiry.",
        {
            "calibration_expired": "`monstertruckd calibrate all`.",
            "response_differs": "`monstertruckd calibrate steering`.",
            "heading_disturbed": "Iron nearby; if it happens everywhere: `monstertruckd calibrate compass`.",
            "wheel_slip": "Smooth floor, or a wheel in the air.",
            "encoders_disagree": "Check the encoder named: disc, cable, side.",
            "sensors_disagree": "Check both sensors named: mount, cable, wheels; then arm again.",
            "sensor_frozen": "Replug the sensor named.",
            "unwitnessed": "`monstertruckd doctor` names the missing sensor.",
            "imu_disagrees": "Check that it is screwed down; `monstertruckd calibrate imu`.",
            "time_offset": "`monstertruckd calibrate lidar` prints the offset.",
            "lidar_turned": "`monstertruckd calibrate lidar`; if the robot crabs: `monstertruckd calibrate steering`.",
            "odometry_dropped": "Check the wheels; calibrate drive and odometry.",
            "pose_lost": "Drive slowly where the lidar sees many walls.",
            "match_degenerate": "A bare corridor: the pose continues by odometry.",
            "map_changed": "Map every floor by itself.",
            "outside_map": "Check that the map is of this place: `monstertruckd map localise`.",
            "scan_left_out": "Tilted or covered: level the lidar.",
        },
    ),
    Symptom(
        "It does not reach its goal",
        "The output of `goto` and the journal state the reason.",
        {
            "path_lost": "Start closer to the path.",
            "cusp_missed": "Send the goal again; if it recurs, `monstertruckd calibrate drive`.",
            "planner_starting": "Wait a few seconds.",
            "start_blocked": "Drive it clear by hand.",
            "goal_blocked": "Choose another goal.",
            "goal_outside": "Choose a goal on the map, or extend the map.",
            "goal_unreachable": "Clear the passage (the robot plus its margins must fit), or choose another goal.",
            "route_timeout": "Increase `planner.route.budget`, or add a waypoint.",
            "path_blocked": "Clear the way.",
            "goal_missed": "Send the goal again; if it recurs, `monstertruckd calibrate odometry`.",
            "goal_timeout": "Increase `planner.timeout`, or send the goal again.",
            "stuck": "Free it by hand.",
            "no_map": "Configure a map, or `slam`.",
            "input_stale": "Check the sensor or robot named in the message (`status`).",
            "input_contradictory": "Check the mounts and cables of the sensors named in the message.",
            "not_obeyed": "Another source drives, or the gate stops it.",
            "mission_incomplete": "The event names the failed steps: remove their causes and start the mission again.",
        },
    ),
    Symptom(
        "The computer",
        "`monstertruckd doctor` finds each of these before the drive and names the command that fixes it.",
        {
            "host_hot": "Check fan and dust.",
            "host_throttled": "Heat, or a weak power supply.",
            "host_busy": "`top`.",
            "memory_low": "End other programs; reduce the map's resolution or the recorded topics.",
            "disk_low": "Copy the logs to another computer and delete them.",
            "disk_full": "Copy the logs to another computer and delete them (`monstertruckd log list`).",
            "recording_failed": "The card may be worn out: replace it.",
            "log_damaged": "`monstertruckd log recover`.",
            "file_damaged": "The event names what replaces the file. Check it, then reset the stop.",
            "link_weak": "Move closer to the access point, or use a better antenna.",
            "link_down": "Check the access point and the cable; `ip -brief link`.",
            "link_open": "The network is open: use WPA2 and certificates.",
            "clock_unset": "`sudo timedatectl set-ntp true`, and connect to a network; or add a clock chip.",
            "clock_stepped": "Wait for NTP before driving; the logs keep both times.",
            "tick_stalled": "Another process takes the processor.",
            "messages_dropped": "End other programs; from the `recorder`: use a faster disk.",
            "worker_timeout": "End other programs; on a slow computer increase the deadline of the worker named.",
            "worker_died": "The journal has its last output.",
        },
    ),
    Symptom(
        "A command ends with an error",
        "The message names the file, line or key, and what was expected.",
        {
            "internal": "A bug: report it with the log.",
            "bad_config": "`monstertruckd config show FILE`.",
            "bad_input": "Correct the argument or file named in the message.",
            "not_found": "Check the name, or whether the robot runs (`monstertruckd status`).",
            "timeout": "Is the daemon running? `systemctl status monstertruckd`.",
            "cancelled": "Start the command again.",
            "not_installed": "Run the command in the message.",
            "command_failed": "The message contains the program's output; `monstertruckd doctor` checks prerequisites.",
            "replay_differs": "Compare the versions; if only the last digits differ, set `--tolerance`.",
        },
    ),
)


def page() -> Page:
    """The page."""
    texts = {reason.value: reason.text for reason in Reason}
    parts = [
        "# What to do when ...",
        "Find the symptom, then the reason named by the event, stop or command, and its remedy.",
    ]
    for symptom in SYMPTOMS:
        rows = [(f"`{name}`", texts[name], todo) for name, todo in symptom.reasons.items()]
        parts += [f"## {symptom.seen}", symptom.first, table(("reason", "meaning", "remedy"), rows)]
    return Page("what-to-do.md", cell("What to do when ..."), join(*parts))
