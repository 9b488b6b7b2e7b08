"""The scripted faults."""

import math
from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any, Final

import numpy as np

from benchmarks.fault_parts.scenario import SENSORS, Expect, Scenario, ScenarioContext
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.topics import Topic
from monstertruck_sim.faults import (
    ALL_ROUND,
    Action,
    Fault,
    SimContext,
    block_shaft,
    clear_obstacles,
    command,
    exchange_cables,
    nothing,
    place_obstacle,
)
from monstertruck_sim.world.config import GroundTilt, SinusoidTilt
from monstertruckd.tools.simulation.config import DEADMAN_LINE

STALE: Final[Mapping[str, Reason]] = {
    DeviceRole.LIDAR: Reason.SCAN_STALE,
    DeviceRole.COMPASS: Reason.ATTITUDE_STALE,
    DeviceRole.DRIVE: Reason.DRIVE_STALE,
    DeviceRole.STEERING: Reason.STEERING_STALE,
}
BY_REQUESTS: Final[Mapping[str, Any]] = {"tracker": None, "path": None}
HUNG_WORKER: Final[Mapping[str, Any]] = {"map": {"latency": 5.0, "deadline": 1.0, "period": 0.5}}
"""Its steps take five times as long as they may."""
WITHOUT_LINE: Final = dict.fromkeys(SENSORS, Expect.STOP) | {DeviceRole.DRIVE: Expect.STOP_AGAIN}


def poison(topic: Topic[Any]) -> Action[ScenarioContext]:
    """A bug in the readers of a topic."""
    return lambda context: context.poison(topic)


def set_charge(share: float) -> Action[SimContext]:
    """A battery charged to 0..1."""
    return lambda context: context.robot.world.set_charge(context.clock.now(), share)


def station(*, silent: bool = False, speed: float = 0.18) -> Action[ScenarioContext]:
    """Requests of the station from then on."""

    def act(context: ScenarioContext) -> None:
        context.station.silent, context.station.speed = silent, speed

    return act


def tilt(context: ScenarioContext) -> None:
    """Tilt the nose up within two seconds, beyond the limit."""
    now = context.clock.now()
    frequency = 0.5 / ((now - context.began) / SECOND)  # so that the sinusoid crosses zero now, downwards
    context.robot.world.set_tilt(now, SinusoidTilt(kind="sinusoid", pitch_deg=45.0, frequency=frequency))


def level(context: SimContext) -> None:
    """Return to level ground."""
    context.robot.world.set_tilt(context.clock.now(), GroundTilt())


def noise(role: str) -> Scenario:
    """Random bytes, then flipped bits."""
    burst = np.random.default_rng(len(role)).bytes(100).hex()
    return Scenario(
        Fault(
            f"{role}: garbage on the line",
            command(role, f"line garbage {burst}", "line flip_rate 0.02"),
            command(role, "line flip_rate 0"),
        ),
        Expect.ENDURE,
        device=role,
    )


def of_device(role: str) -> Iterator[Scenario]:
    """Faults of any device's cable."""
    stop = WITHOUT_LINE[role]
    stale = (STALE[role],)
    lost = {role: Reason.DEVICE_LOST}
    yield Scenario(
        Fault(f"{role}: unplugged", command(role, "unplug"), command(role, "plug")),
        stop,
        seen=stale,
        down=lost,
        device=role,
    )
    yield Scenario(
        Fault(f"{role}: stalled", command(role, "line stalled on"), command(role, "line stalled off")),
        stop,
        seen=stale,
        device=role,
        timeout=4.0,
    )
    yield noise(role)
    yield Scenario(
        Fault(f"{role}: one-byte reads", command(role, "line chunk 1"), command(role, "line chunk off")),
        Expect.GO_ON,
        resumes=True,
    )


def with_line() -> Iterator[Scenario]:
    """Faults with a deadman line: the drive's link is lost, or the line itself falls."""
    for name, broken, mended in (
        ("unplugged", "unplug", "plug"),
        ("stalled", "line stalled on", "line stalled off"),
    ):
        yield Scenario(
            Fault(f"drive: {name}, deadman line wired", command("drive", broken), command("drive", mended)),
            Expect.STOP_BY_LINE,
            seen=(Reason.DRIVE_STALE,),
            device=DeviceRole.DRIVE,
            overlay=DEADMAN_LINE,
            timeout=4.0,
        )
    yield Scenario(
        Fault("steering: supply dips for 0.1 s, deadman line wired", command("steering", "brown_out 0.1")),
        Expect.STOP,
        down={DeviceRole.DRIVE: Reason.DEVICE_STOPPED},
        overlay=DEADMAN_LINE,
    )


def wrong_devices() -> Iterator[Scenario]:
    """Exchange two cables while the truck stands."""
    wrong, silent = Reason.DEVICE_WRONG, Reason.DEVICE_TIMEOUT  # a servo controller says nothing to strange questions
    for one, other, reasons in (
        (DeviceRole.LIDAR, DeviceRole.COMPASS, (wrong, wrong)),
        (DeviceRole.LIDAR, DeviceRole.DRIVE, (wrong, wrong)),
        (DeviceRole.LIDAR, DeviceRole.STEERING, (silent, wrong)),
        (DeviceRole.COMPASS, DeviceRole.DRIVE, (wrong, wrong)),
        (DeviceRole.COMPASS, DeviceRole.STEERING, (silent, wrong)),
        (DeviceRole.DRIVE, DeviceRole.STEERING, (silent, wrong)),
    ):
        yield Scenario(
            Fault(
                f"{one} and {other}: cables exchanged",
                exchange_cables(one, other),
                exchange_cables(one, other),
                hold=6.0,
            ),
            Expect.REFUSE,
            down=dict(zip((one, other), reasons, strict=True)),
            timeout=4.0,
        )


def of_the_lidars_view() -> Iterator[Scenario]:
    """Cover the lidar's window: scans continue, in time and well-formed."""
    blind = (Reason.LIDAR_SLOW, Reason.LIDAR_BLIND)
    for name, fault, seen in (
        ("covered all round", f"cover {ALL_ROUND} 19", (Reason.SCAN_STALE,)),
        ("left half covered", "cover 0 135 6", blind),
        ("right half covered", "cover -135 0 16", blind),
        ("hand before the window", "cover -25 25 40", (Reason.OBSTACLE_STOP,)),
        ("mirror ahead", "mirror -30 30", blind),
        ("sun ahead", "cover -30 30 8 0.7", blind),
    ):
        yield Scenario(
            Fault(f"lidar: {name}", command("lidar", fault), command("lidar", "cover off")),
            Expect.STOP,
            seen=seen,
            resumes=Reason.SCAN_STALE not in seen,
        )
    yield Scenario(
        Fault("lidar: haze", command("lidar", f"cover {ALL_ROUND} 7 0.2"), command("lidar", "cover off")),
        Expect.GO_ON,
        resumes=True,
    )


def of_the_lidars_clock() -> Iterator[Scenario]:
    """Let its clock drift from the computer's: the scans stay fresh."""
    for name, ppm, hold in (
        ("1 % slow", -10_000, 45.0),
        ("slewed by -10 %", -100_000, 5.0),
        ("slewed by 10 %", 100_000, 5.0),
    ):
        yield Scenario(
            Fault(f"lidar: clock {name}", command("lidar", f"drift {ppm}"), command("lidar", "drift 0"), hold=hold),
            Expect.GO_ON,
            seen=(Reason.CLOCK_DRIFT,),
            resumes=True,
        )


def of_answers() -> Iterator[Scenario]:
    """Controllers that answer late, or restart before they answer; a blocked motor."""
    yield Scenario(
        Fault("drive: answers 40 ms late", command("drive", "delay 40"), command("drive", "delay 0"), hold=9.0),
        Expect.STOP_AHEAD,
        seen=(Reason.SLOW_LINK, Reason.DRIVE_STALE),
        resumes=True,
    )
    yield Scenario(
        Fault("drive: answers 80 ms late", command("drive", "delay 80"), command("drive", "delay 0"), hold=12.0),
        Expect.STOP_AHEAD,
        seen=(Reason.DRIVE_STALE,),
    )
    yield Scenario(
        Fault("steering: one answer late", command("steering", "late 0.13")),
        Expect.GO_ON,
        resumes=True,
    )
    yield Scenario(
        Fault("drive: supply dips within an exchange", command("drive", "restart 1")),
        Expect.STOP_AGAIN,
        seen=(Reason.DRIVE_STALE,),
        down={DeviceRole.DRIVE: Reason.DEVICE_RESTARTED},
    )
    yield Scenario(
        Fault("drive: shaft blocked", block_shaft(on=True), block_shaft(on=False)),
        Expect.STOP,
        seen=(Reason.SHAFT_BLOCKED,),
    )


def of_the_truck() -> Iterator[Scenario]:
    """Faults of motor, ground, battery and surroundings."""
    yield Scenario(
        Fault(
            "drive: over-current that stays",
            command("drive", "fault over_current"),
            command("drive", "clear"),
            hold=4.0,
        ),
        Expect.STOP,
        seen=(Reason.DRIVE_FAULT,),
        down={DeviceRole.DRIVE: Reason.DEVICE_FAULT},
        timeout=15.0,
    )
    yield Scenario(
        Fault("drive: over-current that passes", command("drive", "fault over_current passing")),
        Expect.STOP,
        seen=(Reason.DRIVE_FAULT,),
    )
    yield Scenario(
        Fault("lidar: scans arrive 0.6 s old", command("lidar", "line delay 0.6"), command("lidar", "line delay 0")),
        Expect.STOP,
        seen=(Reason.SCAN_STALE,),
        device=DeviceRole.LIDAR,
    )
    yield Scenario(
        Fault(
            "lidar: silent for half a second",
            command("lidar", "line stalled on"),
            command("lidar", "line stalled off"),
            hold=0.5,
        ),
        Expect.STOP,
        seen=(Reason.SCAN_STALE,),
        device=DeviceRole.LIDAR,
        resumes=True,
    )
    yield Scenario(
        Fault("dangerous tilt", tilt, level),
        Expect.STOP_AHEAD,
        seen=(Reason.TILT_SLOW, Reason.TILT_STOP),
    )
    yield Scenario(
        Fault("battery low", set_charge(0.07), set_charge(1.0), hold=25.0),
        Expect.SLOW_DOWN,
        seen=(Reason.BATTERY_LOW,),
        resumes=True,
    )
    yield Scenario(
        Fault("battery critical", set_charge(0.02), set_charge(1.0), hold=20.0),
        Expect.STOP_AHEAD,
        seen=(Reason.BATTERY_CRITICAL,),
        timeout=60.0,
    )
    yield Scenario(
        Fault("battery critical before arming", set_charge(0.02), set_charge(1.0), hold=17.0),
        Expect.REFUSE,
        seen=(Reason.BATTERY_CRITICAL,),
        lead=15.0,
        timeout=60.0,
    )
    yield Scenario(
        Fault("obstacle 0.6 m ahead", place_obstacle(0.6), clear_obstacles, hold=8.0),
        Expect.STOP_AHEAD,
        seen=(Reason.OBSTACLE_SLOW, Reason.OBSTACLE_STOP),
        resumes=True,
        by_station=True,
        overlay=BY_REQUESTS,
    )
    yield Scenario(
        Fault("obstacle steps 0.15 m before the bumper", place_obstacle(0.15), clear_obstacles),
        Expect.STOP_AHEAD,
        seen=(Reason.OBSTACLE_STOP,),
        resumes=True,
    )


def of_software() -> Iterator[Scenario]:
    """Faults of requests and workers, and bugs."""
    yield Scenario(
        Fault("station falls silent", station(silent=True), station()),
        Expect.STOP,
        seen=(Reason.LEASE_EXPIRED,),
        by_station=True,
        overlay=BY_REQUESTS,
    )
    yield Scenario(
        Fault("station asks for NaN while the tracker drives", station(speed=math.nan), station(silent=True)),
        Expect.GO_ON,
        seen=(Reason.NOT_FINITE,),
        resumes=True,
    )
    yield Scenario(
        Fault("station asks for NaN", station(speed=math.nan), station(silent=True)),
        Expect.REFUSE,
        seen=(Reason.NOT_FINITE,),
        by_station=True,
        overlay=BY_REQUESTS,
    )
    yield Scenario(
        Fault("map worker hangs", nothing, hold=5.0),
        Expect.GO_ON,
        down={"map": Reason.WORKER_TIMEOUT},
        recovers=False,
        resumes=True,
        overlay=HUNG_WORKER,
    )
    yield Scenario(
        Fault("bug in the tracker", poison(topics.PATH)),
        Expect.STOP,
        seen=(Reason.SERVICE_FAILED,),
        down={"tracker": Reason.INTERNAL},
        recovers=False,
    )
    for name, topic in (("gate", topics.REQ_DRIVE), ("drive's driver", topics.CMD_DRIVE)):
        yield Scenario(
            Fault(f"bug in the {name}", poison(topic)),
            Expect.EXIT,
        )
    yield Scenario(
        Fault("bug in the steering's driver", poison(topics.CMD_STEERING)),
        Expect.EXIT,
    )


SCENARIOS: Final[tuple[Scenario, ...]] = (
    *chain.from_iterable(map(of_device, SENSORS)),
    *with_line(),
    *wrong_devices(),
    *of_the_lidars_view(),
    *of_the_lidars_clock(),
    *of_answers(),
    *of_the_truck(),
    *of_software(),
)
