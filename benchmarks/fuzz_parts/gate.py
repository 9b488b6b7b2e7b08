"""Extreme requests, orders and sensor values straight into the gate of every kind of body, without a daemon.

A run is a sequence of actions on one body, drawn from a seed. Numbers are those at which arithmetic breaks: the least
and greatest of a float, squares that overflow or vanish, angles near a quarter turn, NaN. Times are of the past, of the
future and beyond 64 bits. After every tick all that the gate puts out must be finite and no shaft faster than the
limit; only a gate in `driving` asks for motion, only `arm` leads out of `disarmed`, only `reset` out of an emergency
stop. A sequence that breaks this is cut down to the shortest one that still does.
"""

import math
import random
import traceback
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from pydantic import ValidationError

from monstertruck_schemas.base import servo_fields
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.sensor import (
    Attitude,
    Battery,
    BatteryLevel,
    DriveFeedback,
    DriveMode,
    LaserScan,
    SteeringFeedback,
)
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.core import GateOutput
from tests.unit.gate.rig import BODIES, Robot, show

NUMBERS: Final = (
    *(0.0, 5e-324, 1e-310, 1e-200, 1e-100, 1e-17, 1e-9, 1e-6, 1e-3, 0.1, 0.2, 0.436, 1.57, math.pi / 2, 3.2),
    *(1e3, 1e9, 1e100, 1e154, 1e155, 1e300, 1.7976931348623157e308, math.inf, math.nan),
)
SANE: Final = (0.0, 0.1, -0.1, 0.2)
"""Half of all numbers are of these: a truck that never drives finds little."""
NAMES: Final = ("ann", "bob", "cat")
LENGTH: Final = 40
"""Actions of a run."""
FASTER: Final = 1.001
"""Rounding of the greatest speed."""
WAYS_OUT: Final = {GateMode.DISARMED: {Order.ARM, Order.ESTOP}, GateMode.ESTOPPED: {Order.RESET}}
"""Orders that may lead out of a mode."""
IDLE: Final = frozenset(WAYS_OUT)


class Action(NamedTuple):
    """One action on a gate."""

    what: str
    values: dict[str, Any]


class BrokenRuleError(AssertionError):
    """The gate violated a rule."""


class Finding(NamedTuple):
    """A shortest sequence that violates a rule."""

    kind: str
    """Kind of the body."""
    error: str
    actions: tuple[Action, ...]


def fuzz(seed: int, ticks: int) -> tuple[int, list[Finding]]:
    """Run one body after the other until the gate has ticked this often; return ticks and the distinct findings."""
    rng, done, found = random.Random(seed), 0, dict[tuple[str, str], Finding]()
    with np.errstate(all="ignore"):
        while done < ticks:
            kind = list(BODIES)[rng.randrange(len(BODIES))]
            actions = [_action(rng, len(BODIES[kind].shafts), len(BODIES[kind].straight)) for _ in range(LENGTH)]
            ticked, error = _run(kind, actions)
            done += ticked
            if error is not None and (kind, error) not in found:
                found[kind, error] = Finding(kind, error, tuple(_shortest(kind, error, actions)))
    return done, list(found.values())


def _shortest(kind: str, error: str, actions: list[Action]) -> list[Action]:
    at = 0
    while at < len(actions):
        fewer = actions[:at] + actions[at + 1 :]
        if _run(kind, fewer)[1] == error:
            actions, at = fewer, 0
        else:
            at += 1
    return actions


def _run(kind: str, actions: Sequence[Action]) -> tuple[int, str | None]:
    """Return the number of ticks, and the violated rule or None."""
    robot, ticked = Robot(kind).armed(), 0
    try:
        for what, values in actions:
            if what == "tick":
                for _ in range(values["count"]):
                    _tick(robot, sense=values["sense"])
                    ticked += 1
            elif what == "order":
                _order(robot, **values)
            elif what in ("drive", "twist"):
                getattr(robot, what)(**values)
            elif what == "roll":
                robot.roll(*values["rates"], source=values["source"], role=values["role"])
            else:
                _sense(robot, what, values)
    except BrokenRuleError as error:
        return ticked, str(error)
    except Exception as error:  # noqa: BLE001 - whatever ends the gate is found
        where = traceback.extract_tb(error.__traceback__)[-1]
        return ticked, f"{type(error).__name__} in {where.name}, line {where.lineno} of {where.filename[-40:]}"
    return ticked, None


# What happens


def _number(rng: random.Random) -> float:
    return rng.choice(SANE) if rng.random() < 0.5 else rng.choice((-1.0, 1.0)) * rng.choice(NUMBERS)


def _action(rng: random.Random, shafts: int, angles: int) -> Action:
    a, b, c = (_number(rng) for _ in range(3))
    who = {"source": rng.choice(NAMES), "role": rng.choice((Role.GAMEPAD, Role.STATION))}
    match rng.randrange(13):
        case 0 | 1:
            return Action("drive", {"speed": a, "front": b, "rear": c, **who})
        case 2 | 3:
            return Action("twist", {"vx": a, "vy": b, "wz": c, **who})
        case 4:
            return Action("roll", {"rates": [_number(rng) for _ in range(shafts)], **who})
        case 5:
            order = rng.choice((Order.ARM, *Order))
            to = {"to": rng.choice(NAMES)} if order is Order.HAND_OVER else {}
            return Action("order", {"order": order, **who, **to})
        case 6:
            values = {
                "position": a,
                "velocity": b,
                "current": rng.choice((None, c)),
                "mode": rng.choice(list(DriveMode)),
            }
            code = rng.choice((None, 0, 2**31))
            return Action("feedback", {**_times(rng), **values, "fault_code": code, "shaft": rng.randrange(shafts)})
        case 7:
            servos = servo_fields([_number(rng) for _ in range(angles)])
            return Action("steering", {**_times(rng), **servos, "trusted": rng.random() < 0.8})
        case 8:
            angles_seen = {name: rng.choice((0.0, 1e-310, 1.5, -1.5, 3.1)) for name in ("roll", "pitch")}
            return Action("attitude", {**_times(rng), "heading": abs(a) % 6.28, **angles_seen, "tilt_valid": a != b})
        case 9:
            level = rng.choice(list(BatteryLevel))
            return Action(
                "battery", {**_times(rng), "voltage": rng.choice((None, a)), "raw_voltage": b, "level": level}
            )
        case 10:
            return Action("scan", {**_times(rng), "seed": rng.randrange(2**31), "first": a, "last": b})
        case _:
            return Action("tick", {"count": rng.choice((1, 1, 3, 8)), "sense": rng.random() < 0.9})


def _times(rng: random.Random) -> dict[str, int]:
    """Draw the times of a message, ns after now."""
    late = (0, 0, 0, -1, 1, -(10**8), -2 * 10**9, -(2**63), 2**63)
    return {"stamp": rng.choice(late), "received": rng.choice((0, 0, rng.choice(late)))}


def _sense(robot: Robot, what: str, values: dict[str, Any]) -> None:
    """Send a sensor's message; one that its model rejects never reaches the gate."""
    head = {name: robot.now + values[name] for name in ("stamp", "received")} | {"seq": 1}
    more = {name: value for name, value in values.items() if name not in head}
    try:
        match what:
            case "feedback":
                shaft = more.pop("shaft")
                feedback = DriveFeedback(**head, **more)
                show(robot.gate, feedback, shaft)
            case "steering":
                show(robot.gate, SteeringFeedback(**head, **more))
            case "attitude":
                show(robot.gate, Attitude(**head, **more))
            case "battery":
                show(robot.gate, Battery(**head, **more, cells=6))
            case _:
                show(robot.gate, _scan(head, **more))
    except ValidationError:
        return


def _scan(head: dict[str, int], seed: int, first: float, last: float) -> LaserScan:
    rng = random.Random(seed)
    count = rng.choice((1, 2, 5, 682))
    ranges = [rng.choice((0.0, -1.0, 0.05, 0.3, 1.0, 4.0, 1e-310, 1e308, math.inf, math.nan)) for _ in range(count)]
    codes = [rng.choice((0, 1, 2, 7, 18, 255, 255)) for _ in range(count)]
    return LaserScan(
        **head,
        frame="lidar",
        start_angle=rng.choice((-2.0, first)),
        end_angle=rng.choice((2.0, last)),
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.06,
        range_max=4.0,
        ranges=np.array(ranges),
        codes=np.array(codes, np.uint8),
        intensities=None,
        tilt=None,
    )


# What must hold


def _require(holds: bool, text: str) -> None:
    if not holds:
        raise BrokenRuleError(text)


def _order(robot: Robot, order: Order, **who: Any) -> None:
    before = robot.gate.mode
    answer = robot.order(order, **who)
    after = robot.gate.mode
    led = f"led from {before} to {after}"
    _require(after is before or before not in IDLE or order in WAYS_OUT[before], f"{order} {led}")
    _require(order is not Order.ESTOP or after is GateMode.ESTOPPED, f"{after} after an emergency stop")
    _require(answer == Reason.OK or after is before, f"{order} was refused, but {led}")


def _tick(robot: Robot, *, sense: bool) -> None:
    before = robot.gate.mode
    out: GateOutput = robot.tick(sense=sense)
    numbers = (*out.speeds, *out.motor_velocities, *out.servos, *out.twist, out.front, out.rear, out.stopping_distance)
    _require(all(map(math.isfinite, (*numbers, out.speed_limit))), "an output is not finite")
    _require(max(map(abs, out.speeds)) <= robot.config.speed * FASTER, "a shaft faster than gate.speed")
    _require(out.mode is GateMode.DRIVING or not any(out.speeds), f"a shaft turns though {out.mode}")
    _require(before not in IDLE or out.mode is before, f"a tick led from {before} to {out.mode}")
