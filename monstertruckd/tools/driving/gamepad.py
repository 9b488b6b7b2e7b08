"""Gamepads: decode bytes of a Linux input device to stick positions and orders, using a mapping. Pure.

Records are ``struct input_event`` (linux/input.h) of a 64-bit kernel, with the codes of linux/input-event-codes.h.
Buttons and sticks are placed as in the kernel's gamepad specification (Documentation/input/gamepad.rst).
"""

import math
import struct
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.yaml_files import read_yaml
from monstertruck_schemas.base import Schema, first_mistake
from monstertruckd.tools.driving.modes import SteeringMode
from monstertruckd.tools.driving.teleop import MODE_KEYS, TURN_RADIUS, TeleopRequest, axles

EVENT: Final = struct.Struct("llHHi")
"""Seconds, microseconds, type, code, value."""
EV_SYN, EV_KEY, EV_ABS = 0, 1, 3

BUTTONS: Final = {
    "south": 0x130,
    "east": 0x131,
    "north": 0x133,
    "west": 0x134,
    "left_shoulder": 0x136,
    "right_shoulder": 0x137,
    "left_trigger": 0x138,
    "right_trigger": 0x139,
    "select": 0x13A,
    "start": 0x13B,
    "mode": 0x13C,
    "left_stick": 0x13D,
    "right_stick": 0x13E,
    "up": 0x220,
    "down": 0x221,
    "left": 0x222,
    "right": 0x223,
}
AXES: Final = {
    "left_x": 0,
    "left_y": 1,
    "left_trigger": 2,
    "right_x": 3,
    "right_y": 4,
    "right_trigger": 5,
    "hat_x": 16,
    "hat_y": 17,
}
HALF: Final = 0.5
"""Fraction of its travel beyond which a hat or a trigger is pressed."""

Action = Literal["arm", "stop", "estop", "reset", "next_mode", "previous_mode", "faster", "slower"]
Button = Literal[
    "south", "east", "north", "west", "left_shoulder", "right_shoulder", "left_trigger", "right_trigger", "select",
    "start", "mode", "left_stick", "right_stick", "up", "down", "left", "right",
]  # fmt: skip
Axis = Literal["left_x", "left_y", "left_trigger", "right_x", "right_y", "right_trigger", "hat_x", "hat_y"]
KEYS: Final[dict[str, str]] = {
    "arm": "enter",
    "stop": "escape",
    "estop": "space",
    "reset": "r",
    "faster": "+",
    "slower": "-",
}
"""Keyboard keys with the same action."""
HATS: Final[dict[tuple[int, int], str]] = {(16, -1): "left", (16, 1): "right", (17, -1): "up", (17, 1): "down"}
"""Buttons by hat axis and direction."""


USUAL: Final[dict[Button, Action]] = {
    "start": "arm",
    "south": "stop",
    "east": "estop",
    "west": "reset",
    "north": "next_mode",
    "right": "next_mode",
    "left": "previous_mode",
    "up": "faster",
    "down": "slower",
}
"""Button actions without a mapping."""


class PadMapping(Schema):
    """Functions of a gamepad's sticks and buttons."""

    name: str = "*"
    """Name of the devices that the mapping applies to; may contain * and ?"""
    speed: Axis = "left_y"
    steer: Axis = "left_x"
    side: Axis = "right_x"
    """Sideways by twist, drift in hybrid steering"""
    inverted: Annotated[tuple[Literal["speed", "steer", "side"], ...], Field(strict=False)] = ()
    """Axes with reversed sign; by default up is ahead and left is left"""
    deadman: Annotated[tuple[Button, ...], Field(strict=False, min_length=1)] = ("right_shoulder", "right_trigger")
    """Deadman buttons; the truck moves only while one is held"""
    unseen: tuple[Button, ...] = Field(("left_shoulder",), strict=False)
    """Buttons, one of which must also be held to drive into unseen ground; deadman buttons are ignored here"""
    buttons: dict[Button, Action] = Field(default_factory=lambda: dict(USUAL))

    def fits(self, name: str) -> bool:
        """Return whether the mapping applies to a device of this name."""
        return fnmatch(name, self.name)


def read_mapping(file: Path) -> PadMapping:
    """Read a mapping from YAML.

    Raises:
        InputError: the file cannot be read or is not a mapping; names the first wrong field.
    """
    content: Any = read_yaml(file) or {}
    try:
        return PadMapping.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{file}: {first_mistake(error)}") from error


@dataclass(slots=True)
class Pad:
    """Current state of one gamepad.

    After ``release`` the deadman is off until its button has been seen released.

    Args:
        name: name of the device.
        mapping: functions of its sticks and buttons.
        ranges: minimum and maximum value of every axis, by code.
    """

    name: str
    mapping: PadMapping
    ranges: dict[int, tuple[int, int]]
    _axes: dict[int, float] = field(default_factory=dict)
    _pressed: set[int] = field(default_factory=set)
    _rest: bytes = b""
    _trusted: bool = True
    """The deadman button is valid."""

    def feed(self, data: bytes) -> list[Action]:
        """Process bytes from the device; returns the actions of its buttons."""
        data = self._rest + data
        whole = len(data) - len(data) % EVENT.size
        self._rest = data[whole:]
        actions: list[Action] = []
        for _, _, kind, code, value in EVENT.iter_unpack(data[:whole]):
            if kind == EV_KEY:
                actions += self._key(code, value)
            elif kind == EV_ABS:
                actions += self._move(code, value)
            elif kind == EV_SYN and code == 3:  # the kernel's queue overflowed: held buttons are unknown
                self.release()
        self._trusted |= not self._deadman
        return actions

    def release(self) -> None:
        """Let go: the deadman button is valid again after its release, a stick after a movement."""
        self._trusted = False
        # Other buttons may have been released meanwhile: their next press must not pass for a continued one.
        self._pressed &= {BUTTONS[name] for name in self.mapping.deadman}
        triggers = {AXES[name] for name in self.mapping.deadman if name in AXES}
        self._axes = {code: value for code, value in self._axes.items() if code in triggers}

    @property
    def _deadman(self) -> bool:
        return self._any_of(self.mapping.deadman)

    def _any_of(self, names: tuple[Button, ...]) -> bool:
        """Return whether any of these buttons is held."""
        held = any(BUTTONS[name] in self._pressed for name in names)
        return held or any(self._axes.get(AXES[name], -1.0) > HALF for name in names if name in AXES)

    @property
    def held(self) -> bool:
        """Whether the deadman button is held."""
        return self._trusted and self._deadman

    def motion(self, mode: SteeringMode, speed: float, angle: float) -> TeleopRequest:
        """Return the motion that the sticks request; standstill unless the deadman button is held.

        Args:
            mode: steering mode, which selects the axles that steer.
            speed: speed at full stick deflection (m/s).
            angle: full lock of an axle (rad).
        """
        if not self.held:
            return TeleopRequest(0.0, 0.0, 0.0, (0.0, 0.0, 0.0) if mode is SteeringMode.TWIST else None)
        unseen = self._any_of(tuple(name for name in self.mapping.unseen if name not in self.mapping.deadman))
        ahead, steer, side = (-self._stick(name) for name in ("speed", "steer", "side"))
        if mode is SteeringMode.TWIST:
            return TeleopRequest(0.0, 0.0, 0.0, (ahead * speed, side * speed, steer * speed / TURN_RADIUS), unseen)
        front, rear = axles(mode, steer * angle, side * angle)
        return TeleopRequest(ahead * speed, front, math.copysign(min(abs(rear), angle), rear), unseen=unseen)

    def _stick(self, what: Literal["speed", "steer", "side"]) -> float:
        axis: Axis = getattr(self.mapping, what)
        value = self._axes.get(AXES[axis], 0.0)
        if abs(value) < 0.08:  # dead zone of a stick, as a fraction of its deflection
            return 0.0
        return -value if what in self.mapping.inverted else value

    def _key(self, code: int, value: int) -> list[Action]:
        if value == 0:
            self._pressed.discard(code)
            return []
        before = code in self._pressed
        self._pressed.add(code)
        name = next((name for name, number in BUTTONS.items() if number == code), None)
        action = next((action for button, action in self.mapping.buttons.items() if button == name), None)
        return [] if before or value != 1 or action is None else [action]

    def _move(self, code: int, value: int) -> list[Action]:
        low, high = self.ranges.get(code, (-1, 1))
        position = 2.0 * (value - low) / max(high - low, 1) - 1.0
        before = self._axes.get(code, 0.0)
        self._axes[code] = max(-1.0, min(1.0, position))
        side = (position > HALF) - (position < -HALF)
        if (code, side) not in HATS or side == (before > HALF) - (before < -HALF):
            return []
        action = next((a for button, a in self.mapping.buttons.items() if button == HATS[code, side]), None)
        return [] if action is None else [action]


def key_for(action: Action, mode: SteeringMode) -> str:
    """Return the keyboard key with the same action in the current steering ``mode``."""
    if action in KEYS:
        return KEYS[action]
    modes = list(MODE_KEYS.values())
    step = 1 if action == "next_mode" else -1
    return list(MODE_KEYS)[(modes.index(mode) + step) % len(modes)]
