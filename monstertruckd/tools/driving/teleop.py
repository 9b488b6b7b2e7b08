"""Keyboard driving: convert terminal bytes to keys, and keys to drive requests and orders. Pure.

A terminal reports a key press and repeats it while the key is held, but never reports its release. So every driving key
is valid for a short time only. After the last key there is one neutral request and then none. The truck stops even if
this program hangs or its link breaks, because nothing renews the lease.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.req import Order
from monstertruckd.tools.driving.modes import SPEEDS, SteeringMode

ESCAPE: Final = b"\x1b"
PASTE: Final = b"\x1b[200~"
PASTE_END: Final = b"\x1b[201~"

_FINALS: Final = {
    "A": "up",
    "B": "down",
    "C": "right",
    "D": "left",
    "I": "focus in",
    "O": "focus out",
}
"""Last character of a control sequence (ECMA-48 section 5.4; xterm's arrow keys and focus reports)."""

_NAMES: Final = {"\r": "enter", "\n": "enter", " ": "space", "\x1b": "escape", "\x04": "end"}

STEERING_KEY_STEPS: Final = 8
"""Number of key presses from straight to full lock."""

TURN_RADIUS: Final = 0.2
"""Distance from the base of a point that moves at the current speed when a turning key is held (m)."""

MODE_KEYS: Final = {str(number): mode for number, mode in enumerate(SteeringMode, start=1)}

THROTTLE: Final = {"up": 1, "w": 1, "down": -1, "s": -1}
STEERING: Final = {"left": 1, "a": 1, "right": -1, "d": -1}
DRIFTING: Final = {"z": 1, "c": -1}
CENTRE: Final = "x"
UNSEEN: Final = "v"
"""Key that keeps driving, by default in reverse, into ground that no sensor has seen."""
ORDERS: Final = {"enter": Order.ARM, "space": Order.ESTOP, "escape": Order.STOP, "e": Order.ESTOP, "r": Order.RESET}
ENDS: Final = frozenset({"q", "end"})

Command = Order | Literal["end"]


class KeyReader:
    """Splits a stream of bytes into keys; ignores pasted text."""

    def __init__(self) -> None:
        self._rest = b""
        self._pasting = False

    def feed(self, data: bytes) -> list[str]:
        """Return the names of the keys completed by ``data``; letters are in lower case."""
        self._rest += data
        keys = []
        while (part := self._next()) is not None:
            if part == PASTE:
                self._pasting = True
            elif part == PASTE_END:
                self._pasting = False
            elif not self._pasting and (name := _name(part)) is not None:
                keys.append(name)
        return keys

    def flush(self) -> list[str]:
        """Return the escape key if only its byte is pending; call this when no byte has followed for a moment."""
        rest, self._rest = self._rest, b""
        return ["escape"] if rest == ESCAPE and not self._pasting else []

    def clear(self) -> None:
        """Discard all bytes so far."""
        self._rest, self._pasting = b"", False

    def _next(self) -> bytes | None:
        """Remove and return the first complete key; None without one."""
        length = _length(self._rest)
        if length is None:
            return None
        part, self._rest = self._rest[:length], self._rest[length:]
        return part


def _length(data: bytes) -> int | None:
    """Return the length of the first key (bytes); None while it may be incomplete."""
    if not data or data == ESCAPE:
        return None
    if not data.startswith(ESCAPE):
        return 1
    if data[1:2] == b"O":
        return 3 if len(data) >= 3 else None
    if data[1:2] != b"[":
        return 1 if data[1:2] == ESCAPE else 2
    for index, byte in enumerate(data[2:], start=3):
        if 0x40 <= byte <= 0x7E:
            return index
    return None


def _name(part: bytes) -> str | None:
    if not part.isascii():
        return None
    text = part.decode("ascii")
    if part.startswith((b"\x1b[", b"\x1bO")):
        return _FINALS.get(text[-1])
    if len(part) > 1:
        return None
    return _NAMES.get(text, text.lower() if text.isprintable() else None)


@dataclass(frozen=True, slots=True)
class TeleopRequest:
    """Requested motion, in one of the two forms."""

    speed: float
    """Speed (m/s)."""
    front: float
    """Front axle angle (rad), left positive."""
    rear: float
    twist: tuple[float, float, float] | None = None
    """Velocity of the base vx, vy, wz (m/s, m/s, rad/s), which replaces speed and angles."""
    unseen: bool = False
    """Whether the operator knowingly drives into unseen ground."""


def axles(mode: SteeringMode, steer: float, drift: float) -> tuple[float, float]:
    """Return front and rear axle angle (rad), left positive; ``steer`` > 0 turns, or moves in crab mode, to the left.

    Args:
        mode: steering mode; ``hybrid`` adds a drift to the counter-steered rear axle.
        steer: steering angle (rad).
        drift: drift angle (rad), used in ``hybrid`` mode only.
    """
    match mode:
        case SteeringMode.FRONT:
            return steer, 0.0
        case SteeringMode.REAR:
            return 0.0, -steer
        case SteeringMode.COUNTER:
            return steer, -steer
        case SteeringMode.CRAB:
            return steer, steer
        case SteeringMode.HYBRID:
            return steer, drift - steer
        case SteeringMode.TWIST:
            return 0.0, 0.0


@dataclass(slots=True)
class Teleop:
    """State of keyboard driving. Times are in ns."""

    angle: float = 0.4
    """Full lock of an axle (rad)."""
    first_hold: float = 0.6
    """Validity of a first press (s): longer than the keyboard's delay before it repeats."""
    hold: float = 0.25
    """Validity of a repetition (s)."""
    arm_hold: float = 2.0
    """Duration of neutral requests after arming (s), so that no tracker starts to drive."""
    level: int = 1
    """Index into ``SPEEDS``."""
    mode: SteeringMode = SteeringMode.FRONT
    _steer: int = 0
    _drift: int = 0
    _throttle: int = 0
    _turn: int = 0
    _side: int = 0
    """Turning direction of a twist: 1 left, -1 right, 0 none."""
    _last: str = ""
    _until: int = 0
    """End of the driving keys' validity."""
    _resting: int = 0
    """End of standstill requests without a key."""
    _asking: bool = False
    _unseen: bool = False
    """Whether the latest driving key was the key for unseen ground."""

    @property
    def speed(self) -> float:
        """Speed of the current step (m/s)."""
        return SPEEDS[self.level]

    @property
    def steer(self) -> float:
        """Steering angle (rad), left positive."""
        return self._steer / STEERING_KEY_STEPS * self.angle

    @property
    def drift(self) -> float:
        """Drift angle of the hybrid mode (rad), left positive."""
        return self._drift / STEERING_KEY_STEPS * self.angle

    def press(self, key: str, now: int) -> Command | None:
        """Process a key; returns its command, if any."""
        if key in ENDS:
            self.release()
            return "end"
        if key in THROTTLE or key in STEERING or key in DRIFTING or key in (CENTRE, UNSEEN):
            self._drive(key, now)
        elif key in MODE_KEYS:
            self.mode = MODE_KEYS[key]
            self._turn = self._side = 0
        elif key in ("+", "="):
            self.level = min(self.level + 1, len(SPEEDS) - 1)
        elif key in ("-", "_"):
            self.level = max(self.level - 1, 0)
        elif key == "focus out":
            self.release()
        elif (order := ORDERS.get(key)) is not None:
            self.release()
            if order is Order.ARM:
                self._resting = now + round(self.arm_hold * SECOND)
            return order
        return None

    def _drive(self, key: str, now: int) -> None:
        """Process a driving key: it sets its part of the motion and extends the validity of the rest."""
        standing = now <= self._until
        if not standing:
            self._turn = self._side = 0
        if self.mode is SteeringMode.TWIST:
            self._turn = STEERING.get(key, self._turn)
            self._side = DRIFTING.get(key, self._side)
        else:
            self._steer = _stepped(self._steer, STEERING.get(key, 0))
            self._drift = _stepped(self._drift, DRIFTING.get(key, 0))
        if key == CENTRE:
            self._steer = self._drift = self._turn = self._side = 0
        self._throttle = THROTTLE.get(key, self._throttle if standing else 0)
        self._unseen = key == UNSEEN
        if self._unseen and not (self._throttle or self._turn or self._side):
            self._throttle = -1
        seconds = self.hold if standing and key == self._last else self.first_hold
        self._until = max(self._until, now + round(seconds * SECOND))
        self._last = key

    def release(self) -> None:
        """Release all keys."""
        self._until = self._resting = self._throttle = self._turn = self._side = 0
        self._unseen = False

    def request(self, now: int) -> TeleopRequest | None:
        """Return the current request: the keys' motion, then one standstill, then none."""
        if now <= self._until:
            self._asking = True
            return self._motion()
        asked, self._asking = self._asking, now <= self._resting
        self._throttle = self._turn = self._side = 0
        self._unseen = False
        return self._motion() if asked or self._asking else None

    def _motion(self) -> TeleopRequest:
        """Return the motion requested by the keys."""
        ahead = self._throttle * self.speed
        if self.mode is SteeringMode.TWIST:
            twist = (ahead, self._side * self.speed, self._turn * self.speed / TURN_RADIUS)
            return TeleopRequest(0.0, 0.0, 0.0, twist, self._unseen)
        front, rear = axles(self.mode, self.steer, self.drift)
        return TeleopRequest(ahead, front, math.copysign(min(abs(rear), self.angle), rear), unseen=self._unseen)


def _stepped(steps: int, by: int) -> int:
    return max(-STEERING_KEY_STEPS, min(STEERING_KEY_STEPS, steps + by))
