"""The live screen draws whatever there is, in any terminal."""

import math
import re

import numpy as np
import pytest
from rich.console import Console

from monstertruck_estimation.transforms import mount
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.event import Cause, Event, Severity, Stop
from monstertruck_schemas.health import (
    CalibrationHealth,
    HealthTable,
    LoopHealth,
    RecorderHealth,
    ServiceHealth,
    ServiceState,
)
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.sensor import Attitude, Battery, BatteryLevel, LaserScan, SonarEcho, SonarRanges
from monstertruck_schemas.state import GateMode, GateState, Odometry, Transforms
from monstertruckd.tools.status.screen import ScreenState, draw
from monstertruckd.tools.status.watch import plain

HEADER = {"stamp": 10**9, "received": 10**9, "seq": 0}


def full() -> ScreenState:
    state = ScreenState("truck", heard=0)
    ranges = np.full(682, 1.5)
    ranges[::7] = np.inf
    for message in (
        GateState(
            **HEADER,
            mode=GateMode.DRIVING,
            nonce="n",
            holder="tracker",
            role=Role.TRACKER,
            lease_left=0.2,
            speed_limit=0.08,
            reasons=(Reason.TILT_SLOW,),
        ),
        Odometry(
            **HEADER,
            pose=Pose2D(x=1.25, y=-0.5, yaw=0.5),
            twist=Twist2D(vx=-0.1, vy=0.0, wz=0.0),
            pose_covariance=np.zeros(9),
            twist_covariance=np.zeros(9),
            age=0.0,
        ),
        LaserScan(
            **HEADER,
            start_angle=-2.09,
            end_angle=2.09,
            time_increment=1e-4,
            scan_time=0.1,
            range_min=0.02,
            range_max=5.6,
            ranges=ranges,
            codes=np.full(682, 255, np.uint8),
            tilt=0.05,
        ),
        Attitude(**HEADER, heading=1.0, roll=0.1, pitch=0.2),
        Battery(**HEADER, voltage=None, raw_voltage=0.0, cells=6, level=BatteryLevel.SENSOR_FAULT),
        TrackerState(
            **HEADER, cross_track=0.012, heading_error=0.0, along=5.0, length=10.0, outcome=Reason.DRIVING, path="loop"
        ),
        HealthTable(
            **HEADER,
            services=(ServiceHealth(name="lidar", state=ServiceState.BACKOFF, since=0, restarts=3, detail="lost"),),
        ),
        LoopHealth(**HEADER, ticks=5, lateness_p50=0.0, lateness_p99=0.0012, lateness_max=0.01),
        RecorderHealth(**HEADER, recording=False, reason=Reason.DISK_FULL),
        Event(**HEADER, reason=Reason.TILT_SLOW, severity=Severity.WARNING, source="gate"),
    ):
        state.take(message)
    return state


@pytest.mark.parametrize(("width", "height"), [(80, 24), (103, 30), (104, 30), (200, 60), (20, 5)])
@pytest.mark.parametrize("state", [full(), ScreenState("truck", 0)], ids=["full", "empty"])
def test_it_fits_the_terminal(state: ScreenState, width: int, height: int):
    console = Console(width=width, height=height, record=True, force_terminal=True, color_system="truecolor")
    console.print(draw(state, width), height=height)
    lines = console.export_text().splitlines()
    assert len(lines) <= height
    assert max(map(len, lines)) <= width


def test_it_shows_what_matters():
    console = Console(width=140, height=40, record=True)
    console.print(draw(full(), 140), height=40)
    text = console.export_text()
    for words in (
        "DRIVING",
        "tilted: speed limited",
        "+1.25 -0.50 m",
        "-0.10 m/s",
        "sensor_fault",
        "50%",
        "+1.2 cm",
        "NOT RECORDING: no space left",
        "backoff",
        "  gate: tilted",
        "roll +5.7° pitch +11.5°",
        "2.9° from level",
        "▲",
    ):
        assert words in text
    assert any(0x2800 < ord(sign) < 0x2900 for sign in text), "the scan is drawn"


def test_who_drives_is_said_once():
    state = full()
    assert re.search(r"driver +tracker ", shown(state, 140, 40).export_text())
    assert "(tracker)" not in shown(state, 140, 40).export_text()
    assert state.gate is not None
    state.take(state.gate.model_copy(update={"holder": "ann@desk:7", "role": Role.STATION}))
    assert "ann@desk:7 (station)" in shown(state, 140, 40).export_text()


def test_a_path_driven_to_its_end_is_whole_though_the_next_lap_begins_at_nought():
    state = full()
    state.take(
        TrackerState(**HEADER, cross_track=0.0, heading_error=0.0, along=0.0, length=10.0, outcome=Reason.GOAL_REACHED)
    )
    console = Console(width=140, height=40, record=True)
    console.print(draw(state, 140), height=40)
    assert "100%" in console.export_text()


def test_what_the_tracker_learnt_about_the_steering_is_shown():
    state, text = full(), "front steers 9 % less than calibrated"
    assert state.tracker is not None
    state.take(state.tracker.model_copy(update={"steering_differs": text}))
    state.take(CalibrationHealth(**HEADER, proposed="learnt while driving"))
    drawn = shown(state, 140, 60).export_text()
    assert re.search(r"steering +front steers", drawn)
    assert re.search(r"proposed +learnt while", drawn)
    assert f"steering  {text}" in plain(state)


def test_plain_words_for_pipes():
    text = "\n".join(plain(full()))
    assert "driving, driver tracker, why tilt_slow" in text
    assert "lidar        backoff   restarts 3 lost" in text
    assert "battery   - V, sensor_fault" in text
    assert plain(ScreenState("truck", 0)) == []
    state = ScreenState("truck", 0)
    state.take(Battery(**HEADER, voltage=24.82368826, raw_voltage=24.8, cells=6, level=BatteryLevel.NORMAL))
    assert plain(state) == ["battery   24.82 V, normal"]


def test_a_stopped_truck_says_why():
    state = full()
    assert state.gate is not None
    lidar = Cause(reason=Reason.DEVICE_LOST, source="lidar", since=9 * 10**8, text="lidar: unplugged")
    scan = Cause(reason=Reason.SCAN_STALE, source="lidar", since=9 * 10**8, text="no fresh lidar scan", because=1)
    stop = Stop(**HEADER, number=1, reason=scan.reason, mode=GateMode.STOPPING, causes=(scan, lidar), text="")
    state.take(stop)
    assert state.why_stopped == [], "it drives"
    still = {"stamp": 4 * 10**9, "mode": GateMode.DISARMED, "speed_limit": 0.0}
    state.take(state.gate.model_copy(update=still))
    console = Console(width=140, height=40, record=True)
    console.print(draw(state, 140), height=40)
    text = console.export_text()
    for words in ("stop 3.0 s ago", "no fresh lidar scan (for 100 ms)", "because lidar: unplugged (for 100 ms)"):
        assert words in text
        assert any(line.startswith("stop ") and words in line for line in plain(state))
    state.silence = 12.0
    assert state.why_stopped[0].startswith("stop 15.0 s ago"), "it ages after the robot's end, too"


def test_the_screen_shows_who_waits_and_what_weakens_the_truck():
    state = ScreenState("truck", heard=0)
    gate = {"mode": GateMode.DISARMED, "nonce": "n", "speed_limit": 0.0}
    weakened = ("gate.scan.stale_after 1, default 0.25", "gate.turning null: servos without supply are not noticed")
    state.take(GateState(**HEADER, **gate, waiting=("tracker",), weakened=weakened))
    assert plain(state)[1:] == ["waiting   tracker", *(f"weakened  {setting}" for setting in weakened)]
    console = Console(width=140, height=40, record=True)
    console.print(draw(state, 140), height=40)
    text = console.export_text()
    for words in ("waiting", "tracker", "weakened", "gate.scan.stale_after 1", "gate.turning null"):
        assert words in text


def test_settings_that_weaken_the_truck_leave_room_for_what_changes():
    state = full()
    assert state.gate is not None
    state.take(state.gate.model_copy(update={"weakened": ("gate.scan.critical false: " + "long " * 40,)}))
    console = Console(width=80, height=24, record=True)
    console.print(draw(state, 80), height=24)
    text = console.export_text()
    for name in ("pose", "battery", "speed", "tick late", "weakened"):
        assert f"│ {name} " in text, name


def test_a_busy_computer_is_said_in_words():
    state = full()
    assert "busy" not in "\n".join(plain(state))
    state.take(LoopHealth(**HEADER, ticks=5, lateness_p50=0.0, lateness_p99=0.045, lateness_max=0.05))
    words = "the computer is busy: control ticks come 45 ms late; end other programs"
    assert f"busy      {words}" in plain(state)
    assert "the computer is busy" in shown(state, 140, 40).export_text()


def test_a_log_with_gaps_is_not_shown_as_a_sound_one():
    state = full()
    state.take(RecorderHealth(**HEADER, recording=True, bytes_written=10**6, drops=12))
    assert "12 messages are missing in the log" in " ".join(plain(state))
    assert "12 messages are missing" in shown(state, 140, 40).export_text()
    state.take(RecorderHealth(**HEADER, recording=True, bytes_written=10**6))
    assert "missing" not in " ".join(plain(state)) + shown(state, 140, 40).export_text()


def test_what_a_sensor_said_long_ago_is_not_shown_as_of_now():
    state = full()
    assert state.gate is not None
    state.take(state.gate.model_copy(update={"stamp": 31 * 10**9}))
    text = shown(state, 140, 40).export_text()
    for words in ("pitch +11.5°, 30 s old", "sensor_fault, 30 s old", "driving, 30 s old"):
        assert words in truck(text)
    assert truck(text).count("30 s old") == 6, "speed, pose, battery, tilt, lidar and path"
    assert "scan 30 s old and trail" in text
    assert not re.search("[\u2801-\u28ff]", text), "no scan is drawn"
    state.take(Attitude(**{**HEADER, "stamp": 31 * 10**9}, heading=1.0, roll=0.1, pitch=0.2))
    state.take(Battery(**{**HEADER, "stamp": 10**15}, raw_voltage=0.0, cells=6, level=BatteryLevel.NORMAL))
    text = truck(shown(state, 140, 40).export_text())
    assert "pitch +11.5° lidar" in text
    assert "normal, old" in text, "of before the computer was restarted"


def truck(text: str) -> str:
    """Words of the screen's left column."""
    return " ".join(" ".join(line[1:39] for line in text.splitlines()).split())


def test_what_stopped_the_run_before_does_not_hold_the_next_one():
    state = full()
    assert state.gate is not None
    still = {"mode": GateMode.DISARMED, "speed_limit": 0.0}
    cause = Cause(reason=Reason.SCAN_STALE, source="lidar", since=0, text="no fresh lidar scan")
    state.take(Stop(**HEADER, number=1, reason=cause.reason, mode=GateMode.STOPPING, causes=(cause,), text=""))
    state.take(state.gate.model_copy(update={**still, "stamp": 2 * 10**9}))
    assert state.why_stopped
    state.take(state.gate.model_copy(update={**still, "nonce": "of the next run", "stamp": 9 * 10**9}))
    assert state.why_stopped == []


def test_a_wide_screen_says_why_a_service_does_not_work():
    state = full()
    assert state.health is not None
    rows = (
        ServiceHealth(name="lidar", state=ServiceState.BACKOFF, since=0, detail="/dev/lidar: unplugged\nmore"),
        ServiceHealth(name="drive", state=ServiceState.READY, since=0, reason=Reason.SLOW_LINK, detail="takes 40 ms"),
        ServiceHealth(name="compass", state=ServiceState.READY, since=0),
    )
    state.take(state.health.model_copy(update={"services": rows}))
    text = shown(state, 140, 40).export_text()
    assert "lidar: /dev/lidar: unplugged" in text
    assert "drive: takes 40 ms" in text
    assert "more" not in text
    assert "compass:" not in text


def test_a_disarmed_truck_does_not_drive_its_path():
    state = full()
    state.take(GateState(**HEADER, mode=GateMode.DISARMED, nonce="n", speed_limit=0.0))
    text = shown(state, 140, 40).export_text()
    assert "+1.2 cm waits" in text
    assert "driving" not in text


def shown(state: ScreenState, width: int = 80, height: int = 24) -> Console:
    console = Console(width=width, height=height, record=True, force_terminal=True, color_system="truecolor")
    console.print(draw(state, width), height=height)
    return console


def test_a_small_terminal_shows_the_scan_too():
    text = shown(full()).export_text()
    assert sum(0x2800 < ord(letter) <= 0x28FF for letter in text) > 20
    assert "lidar" in text
    assert "0 of 1 ready" in text
    assert "TILT" in text.upper()


def test_the_echoes_of_sonars_are_drawn_where_they_are_mounted_and_said_in_words():
    state = ScreenState("sonar", heard=0)
    echoes = (
        SonarEcho(name="f", range=1.0, stamp=0),
        SonarEcho(name="l", stamp=0),
        SonarEcho(name="r", answered=False, stamp=0),
    )
    state.take(SonarRanges(**HEADER, sonars=echoes, field_of_view=1.0, range_min=0.02, range_max=3.0))
    assert plain(state) == ["sonars    f 1.00 m, l no echo, r silent"]

    def drawn() -> list[str]:
        lines = shown(state, 140, 40).export_text(styles=True).splitlines()
        return [line for line in lines if re.search("\x1b\\[35m[\u2801-\u28ff]", line)]

    assert drawn() == [], "their places are not known yet"
    state.take(Transforms(**HEADER, transforms=(mount("sonar_f", (0.1, 0.0, 0.0)),)))
    arc = drawn()
    assert 1 <= len(arc) <= 4, "an arc ahead"
    assert "sonars and trail" in shown(state, 140, 40).export_text()
    state.take(Transforms(**HEADER, transforms=(mount("sonar_f", (0.1, 0.0, 0.0), (0.0, 0.0, 1.57)),)))
    assert len(drawn()) > len(arc), "one at the side is upright"


def test_a_scan_is_drawn_from_where_the_lidar_is_mounted():
    state = full()

    def picture() -> list[str]:
        return [line for line in shown(state, 140, 40).export_text().splitlines() if re.search("[\u2801-\u28ff]", line)]

    assert state.scan is not None
    state.take(state.scan.model_copy(update={"frame": "lidar"}))
    before = picture()
    state.take(Transforms(**HEADER, transforms=(mount("base", (0.0, 0.0, 0.0), parent="odom"),)))
    assert picture() == before, "not known"
    state.take(Transforms(**HEADER, transforms=(mount("lidar", (0.3, 0.0, 0.0), (0.0, 0.0, math.pi)),)))
    assert picture() != before


def test_a_robot_that_fell_silent_is_not_shown_as_alive():
    state = full()
    alive = shown(state).export_text(clear=False)
    assert "no word" not in alive
    state.silence = 12.3
    console = shown(state)
    styled = console.export_text(clear=False, styles=True)
    text = console.export_text()
    assert text.startswith("no data from the robot for 12 s")
    assert "DRIVING" in text
    assert styled.count("\x1b[1;37;41m") == 1, "white on red"
    assert set(re.findall(r"\x1b\[([\d;]+)m", styled)) == {"1;37;41", "90", "0"}, "all else is grey"
    assert "mt/truck, 12 s ago" in text
    assert text.splitlines()[-1] == alive.splitlines()[-1], "it still fits"


def test_a_robot_that_was_never_heard_is_waited_for():
    state = ScreenState("truck at tcp/there", heard=0)
    state.silence, state.trouble = 5.0, "no robot answers at tcp/there within 1 s"
    assert shown(state, 120).export_text().startswith("no robot for 5 s: no robot answers at tcp/there within 1 s")
    state.trouble += ": is its daemon running there (`monstertruckd run`), or is it elsewhere (--endpoint)?"
    text = shown(state, 80).export_text()
    assert "elsewhere (--endpoint)?" in text
    assert len(text.splitlines()) == 24


def test_ages_are_of_the_robots_clock():
    state = ScreenState("truck", heard=10**18)
    state.take(
        HealthTable(
            stamp=40 * 10**9,
            received=40 * 10**9,
            seq=0,
            services=(ServiceHealth(name="lidar", state=ServiceState.BACKOFF, since=30 * 10**9, detail=""),),
        )
    )
    state.take(event("tilted", 41 * 10**9))
    assert "11 s" in shown(state).export_text()


def event(text: str, stamp: int = 10**9) -> Event:
    return Event(
        stamp=stamp, received=0, seq=0, reason=Reason.TILT_SLOW, severity=Severity.INFO, source="gate", text=text
    )


def test_an_event_has_the_same_time_on_every_screen_whenever_that_began():
    early, late = ScreenState("truck", heard=0), ScreenState("truck", heard=0)
    real = 1_790_000_000 * 10**9  # 14:13:20 UTC
    early.take(event("first", 10**9), real)
    for state in (early, late):
        state.take(event("stopped", 60 * 10**9), real + 59 * 10**9)
    lines = [next(line for line in shown(it).export_text().splitlines() if "stopped" in line) for it in (early, late)]
    assert lines[0] == lines[1]
    assert " 14:14:19  gate: stopped" in lines[0]


def test_the_newest_events_are_whole():
    state = ScreenState("truck", heard=0)
    long = " ".join(f"word{number}" for number in range(40))
    for text in ("short", long, "and why"):
        state.take(event(text))
    text = " ".join(shown(state).export_text().replace("│", " ").split())
    assert f"gate: {long} [tilt_slow]" in text
    assert "gate: and why" in text
    assert "short" in text
    for _ in range(2):
        state.take(event(long))
    assert " ".join(shown(state).export_text().replace("│", " ").split()).count(f"gate: {long} [tilt_slow]") == 1


def test_without_events_the_scan_has_their_room():
    console = Console(width=80, height=24, record=True)
    console.print(draw(ScreenState("truck", 0), 80), height=24)
    lines = console.export_text().splitlines()
    assert len(lines) - next(number for number, line in enumerate(lines) if "events" in line) == 3
