"""``arm``, ``disarm``, ``estop``, ``reset``: one order each, with its outcome as exit code; ``drive`` by hand."""

import math
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, local_endpoints, robot_on_host
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.robots import robots_here
from monstertruck_schemas.reasons import Reason, in_words
from monstertruckd.tools.cli.connection import with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, finish, on_terminal, print_json, remark, until_stopped
from monstertruckd.tools.cli.places import options_for
from monstertruckd.tools.driving.modes import SPEEDS, SteeringMode

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruck_schemas.req import Order
    from monstertruck_schemas.state import GateState


@dataclass(frozen=True, slots=True)
class OrderOutcome:
    """Outcome of an order."""

    order: "Order"
    reason: Reason
    """OK, or the reason for the refusal."""
    text: str
    state: "GateState"
    """State of the gate after the order."""

    def as_json(self) -> dict[str, Any]:
        """Return all values as plain data."""
        return {
            "order": self.order,
            "accepted": self.reason is Reason.OK,
            "reason": self.reason,
            "text": self.text,
            "mode": self.state.mode,
            "holder": self.state.holder,
            "waiting": self.state.waiting,
            "limited_by": self.state.reasons,
        }


async def give(client: "TruckClient", order: "Order", *, hold: bool = False) -> OrderOutcome:
    """Send an order and wait for its outcome; ``hold`` as in ``TruckClient.order``.

    If an order to arm is cancelled or not answered, an order to disarm follows, because the robot may carry out the
    first one later.

    Raises:
        NoAnswerError: no answer in time.
        NotFoundError: no such robot.
    """
    import asyncio

    from monstertruck_schemas.req import Order
    from monstertruck_schemas.topics import GATE

    try:
        return OrderOutcome(order, Reason.OK, Reason.OK.text, await client.order(order, hold=hold))
    except (asyncio.CancelledError, NoAnswerError):
        if order is Order.ARM:
            with suppress(TruckError):
                await client.order(Order.DISARM)
                remark("disarmed: the gate did not answer the order to arm")
        raise
    except RequestRefusedError as error:
        state = await client.get_retained(GATE)
        if state is None:
            raise NoAnswerError("the robot does not publish its gate state") from error
        return OrderOutcome(order, error.refusal, str(error), state)


async def _announce(client: "TruckClient", *, hold: bool) -> None:
    """Print before arming which planners will start, and which calibrations have expired."""
    from monstertruck_schemas.topics import CALIBRATION, GATE

    calibration = await client.get_retained(CALIBRATION)
    for row in () if calibration is None else calibration.wizards:
        if row.expired:
            remark(f"calibration of {row.wizard} has expired ({row.expired}): monstertruckd calibrate {row.wizard}")
    if not hold and (names := await _set_off(client, await client.get_retained(GATE))):
        print(
            f"arming starts these sources: {', '.join(names)}; --hold arms without starting them",
            file=sys.stderr,
        )


async def _set_off(client: "TruckClient", gate: "GateState | None") -> list[str]:
    """Drivers that start as soon as the robot is armed.

    Sources that request motion now, and the tracker if it has a path.
    """
    import asyncio

    from monstertruck_runtime.mailbox import latest
    from monstertruck_schemas.topics import TRACKER

    names = [] if gate is None else list(gate.waiting)
    if gate is not None and not gate.mode.active and "tracker" not in names:
        with client.subscribe(TRACKER, latest()) as tracker, suppress(TimeoutError):
            async with asyncio.timeout(0.3):  # seconds within which a tracker with a path sends its first request
                along = await tracker.next()
            path = f"path {along.path!r}" if along.path else "its path"
            names.append(f"tracker, along {path} of {along.length:.1f} m")
    return names


def _run(name: str, robot: str, endpoint: str, *, json_output: bool, hold: bool = False) -> None:
    from monstertruck_schemas.req import Order

    order = Order(name)

    async def main(client: "TruckClient", _: "Clock") -> OrderOutcome:
        if order is Order.ARM:
            await _announce(client, hold=hold)
        return await give(client, order, hold=hold)

    outcome = with_robot(main, robot, endpoint, named=False)
    place = robot_on_host(robot, endpoint)
    if json_output:
        print_json(outcome.as_json() | {"robot": place})
    elif outcome.reason is Reason.OK:
        print(f"{place}: {'; '.join(_state_texts(outcome.state))}")
    if order is Order.ESTOP:
        _name_others(robot, endpoint)
    finish(outcome.reason, f"{place}: {name} refused: {outcome.text}")


def _name_others(robot: str, endpoint: str) -> None:
    """Name the robots of this computer that did not receive an emergency stop."""
    if len(local_endpoints(near=endpoint)) > 1:
        for other in robots_here(endpoint):
            if other != (robot, endpoint):
                remark(f"not stopped: {other[0]}: monstertruckd estop {options_for(*other)}")


def _state_texts(state: "GateState") -> Iterator[str]:
    yield state.mode_text
    if state.holder is not None:
        yield f"{state.holder} drives"
    elif state.waiting:
        yield f"{', '.join(state.waiting)} waits to drive"
    if held := in_words(reason for reason in state.hindrances if reason is not Reason.ESTOPPED):
        yield held


def arm(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
    hold: Annotated[
        bool,
        typer.Option(
            "--hold", help="Hold all trackers, also on a configured path, until the robot is armed without this option."
        ),
    ] = False,
) -> None:
    """Allow the robot to move; first prints which planners will start, such as the tracker of a configured path."""
    _run("arm", robot, endpoint, json_output=json_output, hold=hold)


def disarm(
    robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT, json_output: JsonOption = False
) -> None:
    """Stop the robot by its ordinary ramp, and allow no motion until it is armed again."""
    _run("disarm", robot, endpoint, json_output=json_output)


def estop(
    robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT, json_output: JsonOption = False
) -> None:
    """Trigger the emergency stop, which is latched across restarts of the daemon until `reset`."""
    _run("estop", robot, endpoint, json_output=json_output)


def reset(
    robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT, json_output: JsonOption = False
) -> None:
    """Clear an emergency stop; the robot must stand and stays disarmed."""
    _run("reset", robot, endpoint, json_output=json_output)


def drive(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    mode: Annotated[SteeringMode, typer.Option(help="Which axles steer, or twist.")] = SteeringMode.FRONT,
    speed: Annotated[float, typer.Option(min=SPEEDS[0], max=SPEEDS[-1], help="Initial speed, m/s.")] = SPEEDS[1],
    angle: Annotated[float, typer.Option(min=1.0, max=45.0, help="Maximum steering angle of an axle, degrees.")] = 22.5,
    hold: Annotated[
        float,
        typer.Option(
            min=0.1, max=1.0, help="Duration of the first key press, s: slightly above the keyboard's repeat delay."
        ),
    ] = 0.6,
    gamepad: Annotated[
        bool, typer.Option("--gamepad", help="Also drive by a gamepad, which may be plugged in at any time.")
    ] = False,
    mapping: Annotated[
        Path | None,
        typer.Option(
            "--mapping", help="YAML file with the functions of its sticks and buttons (docs/command-line.md)."
        ),
    ] = None,
) -> None:
    """Drive with the keyboard: the robot moves only while a key is held in this terminal.

    `Enter` arms, `W A S D` or the arrow keys drive, `space` is the emergency stop, `r` resets it, `Esc` stops, `1` to
    `5` choose front, rear, counter, crab or hybrid steering, `z` and `c` the drift of hybrid steering, `x` straightens
    the wheels, `+` and `-` change the speed, `q` ends. `v`, held instead of `s`, drives in reverse into ground that no
    sensor has seen, at 0.05 m/s at most. `6` drives by twist: `A` and `D` turn, also on the spot, `z` and `c` move left
    and right.

    With `--gamepad`: the robot moves only while the right shoulder button or trigger is held, into unseen ground
    while the left shoulder button is held as well; left stick, start arms, A stops, B is the emergency stop,
    X resets it, Y or the cross change steering and speed.
    """
    from monstertruck_runtime.errors import InputError
    from monstertruckd.tools.driving.gamepad import PadMapping, read_mapping
    from monstertruckd.tools.driving.session import DriveSession
    from monstertruckd.tools.driving.teleop import Teleop

    if not (on_terminal(sys.stdin) and on_terminal(sys.stdout)):
        raise InputError("drive needs a terminal, to read held keys")
    level = min(range(len(SPEEDS)), key=lambda index: abs(SPEEDS[index] - speed))
    teleop = Teleop(math.radians(angle), first_hold=hold, level=level, mode=mode)
    pad = None if not gamepad and mapping is None else PadMapping() if mapping is None else read_mapping(mapping)
    until_stopped(lambda clock: DriveSession(teleop, clock, sys.stdin, sys.stdout, pad).run(robot, endpoint))
