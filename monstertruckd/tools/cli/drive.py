"""``monstertruckd drive``: the keyboard as a deadman switch."""

import math
import sys
from pathlib import Path
from typing import Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import on_terminal, until_stopped
from monstertruckd.tools.driving.modes import SPEEDS, SteeringMode


def drive(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    mode: Annotated[SteeringMode, typer.Option(help="Which axles steer, or twist.")] = SteeringMode.FRONT,
    speed: Annotated[float, typer.Option(min=SPEEDS[0], max=SPEEDS[-1], help="Speed to begin with, m/s.")] = SPEEDS[1],
    angle: Annotated[float, typer.Option(min=1.0, max=45.0, help="Full lock of an axle, degrees.")] = 22.5,
    hold: Annotated[
        float,
        typer.Option(min=0.1, max=1.0, help="Seconds a first press stands: just above the keyboard's repeat delay."),
    ] = 0.6,
    gamepad: Annotated[
        bool, typer.Option("--gamepad", help="Drive by a gamepad as well, plugged in at any time.")
    ] = False,
    mapping: Annotated[
        Path | None,
        typer.Option("--mapping", help="YAML file with what its sticks and buttons do (docs/command-line.md)."),
    ] = None,
) -> None:
    """Drive with the keyboard: the robot moves only while a key is held, in this terminal.

    `Enter` arms, `W A S D` or the arrow keys drive, `space` stops, `e` is the emergency stop and
    `r` resets it, `1` to `5` choose front, rear, counter, crab or hybrid steering, `z` and `c`
    the drift of the last, `x` straightens the wheels, `+` and `-` change the speed, `q` ends.
    `v`, held in place of `s`, drives in reverse into ground that no sensor has seen, at 0.05 m/s at most.
    `6` drives by twist: `A` and `D` turn, also on the spot, `z` and `c` move left and right.

    With `--gamepad`: the robot moves only while the right shoulder button or trigger is held, into unseen ground
    while the left shoulder button is held as well; left stick, start arms, A stops, B is the emergency stop,
    X resets it, Y or the cross change steering and speed.
    """
    from monstertruck_runtime.errors import InputError
    from monstertruckd.tools.driving.gamepad import PadMapping, read_mapping
    from monstertruckd.tools.driving.session import DriveSession
    from monstertruckd.tools.driving.teleop import Teleop

    if not (on_terminal(sys.stdin) and on_terminal(sys.stdout)):
        raise InputError("drive reads keys as they are held: it needs a terminal")
    level = min(range(len(SPEEDS)), key=lambda index: abs(SPEEDS[index] - speed))
    teleop = Teleop(math.radians(angle), first_hold=hold, level=level, mode=mode)
    pad = None if not gamepad and mapping is None else PadMapping() if mapping is None else read_mapping(mapping)
    until_stopped(lambda clock: DriveSession(teleop, clock, sys.stdin, sys.stdout, pad).run(robot, endpoint))
