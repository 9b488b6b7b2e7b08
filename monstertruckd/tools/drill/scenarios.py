"""The faults for which the whole daemon is drilled."""

import math
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import Any, Final

import numpy as np

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic
from monstertruck_sim.world.config import GroundTilt, SinusoidTilt
from monstertruck_sim.world.obstacles import Disc
from monstertruckd.tools.drill.scenario import SENSORS, Expect, Scenario, Stage

Action = Callable[[Stage], None]

STALE: Final[Mapping[str, Reason]] = {
    "lidar": Reason.SCAN_STALE,
    "compass": Reason.ATTITUDE_STALE,
    "drive": Reason.DRIVE_STALE,
    "steering": Reason.STEERING_STALE,
}
LINE: Final[Mapping[str, Any]] = {
    "devices": {"steering": {"driver": {"deadman_channel": 2}}},
    "sim": {"deadman_wired": True, "servo_timeout": 0.3},
}
"""The deadman line is wired."""
BY_REQUESTS: Final[Mapping[str, Any]] = {"tracker": None, "path": None}
HUNG_WORKER: Final[Mapping[str, Any]] = {"map": {"latency": 5.0, "deadline": 1.0, "period": 0.5}}
"""Its steps take five times as long as they may."""
WITHOUT_LINE: Final = dict.fromkeys(SENSORS, Expect.STOP) | {"drive": Expect.STOP_AGAIN}


def words(role: str, *lines: str) -> Action:
    """Words for the fault console of a device."""

    def act(stage: Stage) -> None:
        for line in lines:
            stage.command(role, line)

    return act


def swap(one: str, other: str) -> Action:
    """Exchange two cables."""
    return lambda stage: stage.swap_cables(one, other)


def poison(topic: Topic[Any]) -> Action:
    """A bug in the readers of a topic."""
    return lambda stage: stage.poison(topic)


def charge(share: float) -> Action:
    """A battery charged to 0..1."""
    return lambda stage: stage.rig.world.set_charge(stage.rig.clock.now(), share)


def station(*, silent: bool = False, speed: float = 0.18) -> Action:
    """What the station does from now on."""

    def act(stage: Stage) -> None:
        stage.station.silent, stage.station.speed = silent, speed

    return act


def obstacle(gap: float, radius: float = 0.1) -> Action:
    """A post ``gap`` metres before the front bumper."""

    def act(stage: Stage) -> None:
        now = stage.rig.clock.now()
        truth = stage.rig.world.truth(now)
        ahead = stage.rig.config.sim.world.truck.length / 2 + gap + radius
        post = Disc(truth.x + ahead * math.cos(truth.yaw), truth.y + ahead * math.sin(truth.yaw), radius)
        stage.rig.world.add(now, post)

    return act


def clear_obstacles(stage: Stage) -> None:
    """Take everything away that was put into the world."""
    for post in stage.rig.world.obstacles:
        stage.rig.world.remove(stage.rig.clock.now(), post)


def tip(stage: Stage) -> None:
    """Nose up within two seconds, beyond what is allowed."""
    now = stage.rig.clock.now()
    frequency = 0.5 / ((now - stage.rig.began) / SECOND)  # so that the swing passes zero now, downwards
    stage.rig.world.set_tilt(now, SinusoidTilt(kind="sinusoid", pitch_deg=45.0, frequency=frequency))


def level(stage: Stage) -> None:
    """Back on level ground."""
    stage.rig.world.set_tilt(stage.rig.clock.now(), GroundTilt())


def noise(role: str) -> Scenario:
    """Random bytes, then flipped bits."""
    burst = np.random.default_rng(len(role)).bytes(100).hex()
    return Scenario(
        f"{role}: garbage on the line",
        words(role, f"line garbage {burst}", "line flip_rate 0.02"),
        Expect.ENDURE,
        words(role, "line flip_rate 0"),
        device=role,
    )


def of_device(role: str) -> Iterator[Scenario]:
    """What can happen to any device's cable."""
    stop = WITHOUT_LINE[role]
    stale = (STALE[role],)
    lost = {role: Reason.DEVICE_LOST}
    yield Scenario(
        f"{role}: unplugged", words(role, "unplug"), stop, words(role, "plug"), seen=stale, down=lost, device=role
    )
    yield Scenario(
        f"{role}: stalled",
        words(role, "line stalled on"),
        stop,
        words(role, "line stalled off"),
        seen=stale,
        device=role,
        patience=4.0,
    )
    yield noise(role)
    yield Scenario(
        f"{role}: one-byte reads",
        words(role, "line chunk 1"),
        Expect.GO_ON,
        words(role, "line chunk off"),
        resumes=True,
    )


def with_line() -> Iterator[Scenario]:
    """The drive's link is lost, and the deadman line is wired."""
    for name, broken, mended in (
        ("unplugged", "unplug", "plug"),
        ("stalled", "line stalled on", "line stalled off"),
    ):
        yield Scenario(
            f"drive: {name}, deadman line wired",
            words("drive", broken),
            Expect.STOP_BY_LINE,
            words("drive", mended),
            seen=(Reason.DRIVE_STALE,),
            device="drive",
            overlay=LINE,
            patience=4.0,
        )


def wrong_devices() -> Iterator[Scenario]:
    """Two cables exchanged while the truck stands."""
    wrong, silent = Reason.DEVICE_WRONG, Reason.DEVICE_TIMEOUT  # a servo controller says nothing to strange questions
    for one, other, reasons in (
        ("lidar", "compass", (wrong, wrong)),
        ("lidar", "drive", (wrong, wrong)),
        ("lidar", "steering", (silent, wrong)),
        ("compass", "drive", (wrong, wrong)),
        ("compass", "steering", (silent, wrong)),
        ("drive", "steering", (silent, wrong)),
    ):
        yield Scenario(
            f"{one} and {other}: cables exchanged",
            swap(one, other),
            Expect.REFUSE,
            swap(one, other),
            down=dict(zip((one, other), reasons, strict=True)),
            hold=6.0,
            patience=4.0,
        )


def of_the_truck() -> Iterator[Scenario]:
    """Faults of motor, ground, battery and surroundings."""
    yield Scenario(
        "drive: over-current that stays",
        words("drive", "fault over_current"),
        Expect.STOP,
        words("drive", "clear"),
        seen=(Reason.DRIVE_FAULT,),
        down={"drive": Reason.DEVICE_FAULT},
        hold=4.0,
        patience=15.0,
    )
    yield Scenario(
        "drive: over-current that passes",
        words("drive", "fault over_current passing"),
        Expect.STOP,
        seen=(Reason.DRIVE_FAULT,),
    )
    yield Scenario(
        "lidar: scans arrive 0.6 s old",
        words("lidar", "line delay 0.6"),
        Expect.STOP,
        words("lidar", "line delay 0"),
        seen=(Reason.SCAN_STALE,),
        device="lidar",
    )
    yield Scenario(
        "lidar: silent for half a second",
        words("lidar", "line stalled on"),
        Expect.STOP,
        words("lidar", "line stalled off"),
        seen=(Reason.SCAN_STALE,),
        device="lidar",
        hold=0.5,
        resumes=True,
    )
    yield Scenario(
        "dangerous tilt",
        tip,
        Expect.STOP_AHEAD,
        level,
        seen=(Reason.TILT_SLOW, Reason.TILT_STOP),
    )
    yield Scenario(
        "battery low", charge(0.07), Expect.SLOW_DOWN, charge(1.0), seen=(Reason.BATTERY_LOW,), hold=25.0, resumes=True
    )
    yield Scenario(
        "battery critical",
        charge(0.02),
        Expect.STOP_AHEAD,
        charge(1.0),
        seen=(Reason.BATTERY_CRITICAL,),
        hold=20.0,
        patience=60.0,
    )
    yield Scenario(
        "battery critical before arming",
        charge(0.02),
        Expect.REFUSE,
        charge(1.0),
        seen=(Reason.BATTERY_CRITICAL,),
        lead=15.0,
        hold=17.0,
        patience=60.0,
    )
    yield Scenario(
        "obstacle 0.6 m ahead",
        obstacle(0.6),
        Expect.STOP_AHEAD,
        clear_obstacles,
        seen=(Reason.OBSTACLE_SLOW, Reason.OBSTACLE_STOP),
        hold=8.0,
        resumes=True,
        by_station=True,
        overlay=BY_REQUESTS,
    )
    yield Scenario(
        "obstacle steps 0.15 m before the bumper",
        obstacle(0.15),
        Expect.STOP_AHEAD,
        clear_obstacles,
        seen=(Reason.OBSTACLE_STOP,),
        resumes=True,
    )


def of_software() -> Iterator[Scenario]:
    """Requests, workers, bugs."""
    yield Scenario(
        "station falls silent",
        station(silent=True),
        Expect.STOP,
        station(),
        seen=(Reason.LEASE_EXPIRED,),
        by_station=True,
        overlay=BY_REQUESTS,
    )
    yield Scenario(
        "station asks for NaN while the tracker drives",
        station(speed=math.nan),
        Expect.GO_ON,
        station(silent=True),
        seen=(Reason.NOT_FINITE,),
        resumes=True,
    )
    yield Scenario(
        "station asks for NaN",
        station(speed=math.nan),
        Expect.REFUSE,
        station(silent=True),
        seen=(Reason.NOT_FINITE,),
        by_station=True,
        overlay=BY_REQUESTS,
    )
    yield Scenario(
        "map worker hangs",
        lambda _: None,
        Expect.GO_ON,
        down={"map": Reason.WORKER_TIMEOUT},
        hold=5.0,
        recovers=False,
        resumes=True,
        overlay=HUNG_WORKER,
    )
    yield Scenario(
        "bug in the tracker",
        poison(topics.PATH),
        Expect.STOP,
        seen=(Reason.SERVICE_FAILED,),
        down={"tracker": Reason.INTERNAL},
        recovers=False,
    )
    for name, topic in (("gate", topics.REQ_DRIVE), ("drive's driver", topics.CMD_DRIVE)):
        yield Scenario(f"bug in the {name}", poison(topic), Expect.EXIT)
    yield Scenario("bug in the steering's driver", poison(topics.CMD_STEERING), Expect.EXIT)


SCENARIOS: Final[tuple[Scenario, ...]] = (
    *chain.from_iterable(map(of_device, SENSORS)),
    *with_line(),
    *wrong_devices(),
    *of_the_truck(),
    *of_software(),
)
