"""Keyboard driving without a terminal: keys in, requests and orders out. Pure.

A terminal tells that a key went down and repeats it while it is held, but never that it was let go. So every driving
key stands for a short time only, and with none standing there is one neutral request and then silence: the truck stops
even if this program hangs or its link breaks, for nothing renews the lease.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.req import Order
from monstertruckd.tools.cli.driving_modes import SPEEDS, SteeringMode

STEPS: Final = 8
"""Key presses from straight to full lock."""

MODE_KEYS: Final = {str(number): mode for number, mode in enumerate(SteeringMode, start=1)}

THROTTLE: Final = {"up": 1, "w": 1, "down": -1, "s": -1}
STEERING: Final = {"left": 1, "a": 1, "right": -1, "d": -1}
DRIFTING: Final = {"z": 1, "c": -1}
CENTRE: Final = "x"
ORDERS: Final = {"enter": Order.ARM, "space": Order.STOP, "escape": Order.STOP, "e": Order.ESTOP, "r": Order.RESET}
ENDS: Final = frozenset({"q", "end"})

Command = Order | Literal["end"]


@dataclass(frozen=True, slots=True)
class TeleopRequest:
    """What to ask of the gate."""

    speed: float
    """m/s."""
    front: float
    """rad, left positive."""
    rear: float


def axles(mode: SteeringMode, steer: float, drift: float) -> tuple[float, float]:
    """Front and rear axle angle, rad, left positive; ``steer`` > 0 turns, or in crab moves, to the left.

    Args:
        mode: which axles steer; ``hybrid`` adds a drift to the counter-steered rear axle.
        steer: rad.
        drift: rad; counts in ``hybrid`` only.
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


@dataclass(slots=True)
class Teleop:
    """State between the keys. Times are ns."""

    angle: float = 0.4
    """Full lock of an axle, rad."""
    first_hold: float = 0.6
    """Seconds a first press stands: longer than the keyboard waits before it repeats."""
    hold: float = 0.25
    """Seconds a repetition stands."""
    arm_hold: float = 2.0
    """Seconds the keyboard holds the truck at rest after arming it, so that no tracker drives off instead."""
    level: int = 1
    """Index into ``SPEEDS``."""
    mode: SteeringMode = SteeringMode.FRONT
    _steer: int = 0
    _drift: int = 0
    _throttle: int = 0
    _last: str = ""
    _until: int = 0
    """What the driving keys ask for stands until then."""
    _resting: int = 0
    """Until then the truck is held at rest where no key stands."""
    _asking: bool = False

    @property
    def speed(self) -> float:
        """Speed of the present step, m/s."""
        return SPEEDS[self.level]

    @property
    def steer(self) -> float:
        """Steering, rad, left positive."""
        return self._steer / STEPS * self.angle

    @property
    def drift(self) -> float:
        """Drift of the hybrid mode, rad, left positive."""
        return self._drift / STEPS * self.angle

    @property
    def throttle(self) -> int:
        """1 forward, -1 back, 0 none."""
        return self._throttle

    def press(self, key: str, now: int) -> Command | None:
        """Take a key; returns what is to be done at once."""
        if key in ENDS:
            self.release()
            return "end"
        if key in THROTTLE or key in STEERING or key in DRIFTING or key == CENTRE:
            self._drive(key, now)
        elif key in MODE_KEYS:
            self.mode = MODE_KEYS[key]
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
        """A driving key: it sets its own part and keeps the rest standing."""
        self._steer = _stepped(self._steer, STEERING.get(key, 0))
        self._drift = _stepped(self._drift, DRIFTING.get(key, 0))
        if key == CENTRE:
            self._steer = self._drift = 0
        standing = now <= self._until
        self._throttle = THROTTLE.get(key, self._throttle if standing else 0)
        seconds = self.hold if standing and key == self._last else self.first_hold
        self._until = max(self._until, now + round(seconds * SECOND))
        self._last = key

    def release(self) -> None:
        """All keys count as let go."""
        self._until = self._resting = self._throttle = 0

    def request(self, now: int) -> TeleopRequest | None:
        """What to ask for now: the keys' motion, once a stop after it, then nothing."""
        front, rear = axles(self.mode, self.steer, self.drift)
        rear = math.copysign(min(abs(rear), self.angle), rear)
        if now <= self._until:
            self._asking = True
            return TeleopRequest(self._throttle * self.speed, front, rear)
        asked, self._asking, self._throttle = self._asking, now <= self._resting, 0
        return TeleopRequest(0.0, front, rear) if asked or self._asking else None


def _stepped(steps: int, by: int) -> int:
    return max(-STEPS, min(STEPS, steps + by))
