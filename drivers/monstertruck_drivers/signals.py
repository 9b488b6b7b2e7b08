"""Signals of an emulated device: the values it reports, the commands it executes, and the faults that falsify them.

An emulator names its signals once and passes each value through ``report`` or ``order``; every fault in this module
then applies to every signal. Tests and drills derive their fault families from ``Signals.faults``.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any, Final, TypeVar

import numpy as np

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError

T = TypeVar("T")
R = TypeVar("R")


class SignalKind(StrEnum):
    """Kind of a signal."""

    NUMBER = "number"
    ARRAY = "array"
    """An array of one dimension; neighbours in it are neighbours in space."""
    THING = "thing"
    """A value without arithmetic, such as an image or a state."""
    ORDER = "order"
    """A command with a number, such as a speed."""
    SWITCH = "switch"
    """A command without a number, such as a quick stop."""


ARITHMETIC: Final = frozenset({SignalKind.NUMBER, SignalKind.ARRAY, SignalKind.ORDER})
REPORTS: Final = frozenset({SignalKind.NUMBER, SignalKind.ARRAY, SignalKind.THING})
COMMANDS: Final = frozenset({SignalKind.ORDER, SignalKind.SWITCH})


@dataclass(slots=True)
class Context:
    """Inputs of a distortion.

    Args:
        newest: latest true value of the signal; None before the first one.
        neighbour: returns the last true value of the next signal of the same kind; None if it has had none.
        rng: random generator.
    """

    newest: Any
    neighbour: Callable[[], Any]
    rng: np.random.Generator


LOST: Final = object()
"""Result of a distortion of a command that is not executed."""

Distortion = Callable[[Any, int], Any]
"""Falsifies a value: (true value, time in ns) to the value that is used, or ``LOST``."""


def _like(original: Any, result: Any) -> Any:
    """Return ``result`` in the type of ``original``: integers remain integers."""
    if isinstance(original, np.ndarray):
        whole = np.issubdtype(original.dtype, np.integer)
        return (np.rint(result) if whole else result).astype(original.dtype)
    return round(float(result)) if isinstance(original, int) else float(result)


def _scaled(_: Context, factor: float) -> Distortion:
    return lambda value, _now: _like(value, value * factor)


def _offset(_: Context, amount: float) -> Distortion:
    return lambda value, _now: _like(value, value + amount)


def _negated(_: Context) -> Distortion:
    return lambda value, _now: -value


def _quantised(_: Context, step: float) -> Distortion:
    if step <= 0:
        raise ValueError("expected a step above 0")
    return lambda value, _now: _like(value, np.rint(value / step) * step)


def _noisy(context: Context, sigma: float) -> Distortion:
    return lambda value, _now: _like(value, value + sigma * context.rng.standard_normal(np.shape(value)))


def _frozen(context: Context) -> Distortion:
    kept = [] if context.newest is None else [context.newest]

    def hold(value: Any, _now: int) -> Any:
        if not kept:
            kept.append(value)
        return kept[0]

    return hold


def _delayed(context: Context, seconds: float) -> Distortion:
    line: deque[tuple[int, Any]] = deque()
    old = context.newest

    def late(value: Any, now: int) -> Any:
        nonlocal old
        line.append((now + round(seconds * SECOND), value))
        while line and line[0][0] <= now:
            old = line.popleft()[1]
        return value if old is None else old

    return late


def _dropped(context: Context, share: float) -> Distortion:
    kept = context.newest

    def hold(value: Any, _now: int) -> Any:
        nonlocal kept
        if kept is None or context.rng.random() >= share:
            kept = value
        return kept

    return hold


def _repeated(_: Context, times: float) -> Distortion:
    kept, left = None, 0

    def repeat(value: Any, _now: int) -> Any:
        nonlocal kept, left
        if left <= 0:
            kept, left = value, round(times)
        left -= 1
        return kept

    return repeat


def _swapped(context: Context) -> Distortion:
    def other(value: Any, _now: int) -> Any:
        newest = context.neighbour()
        return value if newest is None else _like(value, newest)

    return other


def _sparing(distort: Distortion, least: float) -> Distortion:
    """Apply a distortion only to array values of at least ``least``: lower values are codes."""

    def spare(value: Any, now: int) -> Any:
        shown = np.array(distort(value, now))
        shown[value < least] = value[value < least]
        return shown

    return spare


def _shifted(_: Context, places: float) -> Distortion:
    return lambda value, _now: np.roll(value, round(places))


def _mirrored(_: Context) -> Distortion:
    return lambda value, _now: value[::-1]


def _ignored(_: Context) -> Distortion:
    return lambda _value, _now: LOST


def _lost(context: Context, share: float) -> Distortion:
    return lambda value, _now: LOST if context.rng.random() < share else value


def _growing(context: Context) -> Distortion:
    greatest = context.newest

    def hold(value: Any, _now: int) -> Any:
        nonlocal greatest
        if greatest is not None and abs(value) < abs(greatest):
            return LOST
        greatest = value
        return value

    return hold


@dataclass(frozen=True, slots=True)
class _Later:
    """A command that is executed later."""

    seconds: float


def _late(_: Context, seconds: float) -> Distortion:
    return lambda _value, _now: _Later(seconds)


@dataclass(frozen=True, slots=True)
class SignalFault:
    """A fault that falsifies signals.

    Args:
        make: builds the distortion from its context and, if it has one, its argument.
        kinds: applicable kinds of signals.
        argument: name and unit of the argument for help texts; empty for a fault without an argument.
    """

    make: Callable[..., Distortion]
    kinds: frozenset[SignalKind]
    argument: str = ""


FAULTS: Final[Mapping[str, SignalFault]] = {
    "scaled": SignalFault(_scaled, ARITHMETIC, "FACTOR"),
    "offset": SignalFault(_offset, ARITHMETIC, "AMOUNT"),
    "negated": SignalFault(_negated, ARITHMETIC),
    "quantised": SignalFault(_quantised, ARITHMETIC, "STEP"),
    "noisy": SignalFault(_noisy, ARITHMETIC, "SIGMA"),
    "frozen": SignalFault(_frozen, REPORTS),
    "delayed": SignalFault(_delayed, REPORTS, "SECONDS"),
    "dropped": SignalFault(_dropped, REPORTS, "SHARE"),
    "repeated": SignalFault(_repeated, REPORTS, "TIMES"),
    "swapped": SignalFault(_swapped, frozenset({SignalKind.NUMBER, SignalKind.ORDER})),
    "shifted": SignalFault(_shifted, frozenset({SignalKind.ARRAY}), "PLACES"),
    "mirrored": SignalFault(_mirrored, frozenset({SignalKind.ARRAY})),
    "ignored": SignalFault(_ignored, COMMANDS),
    "late": SignalFault(_late, COMMANDS, "SECONDS"),
    "lost": SignalFault(_lost, COMMANDS, "SHARE"),
    "growing": SignalFault(_growing, frozenset({SignalKind.ORDER})),
}
"""Every fault of a signal by name; arguments are in the signal's unit. ``growing`` executes a command only if its
magnitude is not below that of the previous command.
"""


HELP: Final = "of its signals: signal NAME off|" + "|".join(
    f"{name} {fault.argument}".strip() for name, fault in FAULTS.items()
)


class Signals:
    """The signals of one device.

    Args:
        now: returns the current time (ns).
        kinds: kinds of the signals by name; their order defines the neighbours.
        rng: the device's random generator, from which the faults' generators are spawned.
        codes: minimum measured value by array name; lower values are codes, which arithmetic faults do not change.

    Raises:
        InputError: a kind is not a ``SignalKind``.
    """

    def __init__(
        self,
        now: Callable[[], int],
        kinds: Mapping[str, SignalKind],
        rng: np.random.Generator,
        codes: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self.kinds = dict(kinds)
        for name, kind in self.kinds.items():
            if kind not in SignalKind.__members__.values():
                expected = " or ".join(f"SignalKind.{one}" for one in SignalKind.__members__)
                raise InputError(f"signal {name}: expected {expected}, found {kind!r}")
        self._codes = dict(codes)
        self._now = now
        self._rng = rng.spawn(1)[0]
        self._newest: dict[str, Any] = {}
        self._greatest: dict[str, float] = {}
        self._active: dict[str, list[Distortion]] = {}
        self._due: dict[str, int] = {}
        """Execution time of a signal's latest delayed command (ns); later commands never overtake it."""

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield every (signal, fault) that ``inject`` accepts; ``swapped`` only for signals with a neighbour."""
        for name, kind in self.kinds.items():
            for fault, what in FAULTS.items():
                if kind in what.kinds and (fault != "swapped" or self._neighbour(name) is not None):
                    yield name, fault

    def used(self, name: str) -> bool:
        """Whether the host has ever read the value or sent the command."""
        return name in self._newest

    def extent(self, name: str) -> float:
        """Return the maximum magnitude of a number, array or order so far, in its unit; 0 before the first value."""
        newest = self._newest.get(name)
        return float(np.abs(newest).max()) if isinstance(newest, np.ndarray) else self._greatest.get(name, 0.0)

    def inject(self, name: str, fault: str, *values: str) -> None:
        """Add a fault to a signal; ``off`` ends all faults of the signal.

        Raises:
            InputError: the signal or the fault is unknown, or the argument is invalid.
        """
        if name not in self.kinds:
            raise InputError(f"signal {name!r}: expected one of {', '.join(self.kinds)}")
        if fault == "off" and not values:
            self._active.pop(name, None)
            return
        known = FAULTS.get(fault)
        if known is None or self.kinds[name] not in known.kinds:
            raise InputError(f"signal {name}: fault {fault!r} does not fit a {self.kinds[name]}; {HELP}")
        context = Context(self._newest.get(name), lambda: self._newest.get(self._neighbour(name) or name), self._rng)
        try:
            distortion = known.make(context, *map(float, values))
        except (TypeError, ValueError) as error:
            raise InputError(f"signal {name} {fault}: cannot read {' '.join(values)!r}; {HELP}") from error
        if name in self._codes and known.kinds == ARITHMETIC:
            distortion = _sparing(distortion, self._codes[name])
        self._active.setdefault(name, []).append(distortion)

    def report(self, name: str, value: T) -> T:
        """Return the value that the device reports instead of the true ``value``."""
        self._remember(name, value)
        distortions = self._active.get(name)
        if distortions is None:
            return value
        now, shown = self._now(), value
        for distort in distortions:
            shown = distort(shown, now)
        return shown

    def order(self, name: str, value: T, obey: Callable[[T], R]) -> R | None:
        """Execute a command with ``value`` as falsified by the signal's faults.

        Returns:
            The result of ``obey``; None if it is called later or never.
        """
        distortions = self._active.get(name, ())
        now, given, late = self._now(), value, 0.0
        for distort in distortions:
            result = distort(given, now)
            if result is LOST:
                return None
            if isinstance(result, _Later):
                late += result.seconds
            else:
                given = result
        self._remember(name, value)
        due = max(now + round(late * SECOND), self._due.get(name, 0))
        if due <= now:
            return obey(given)
        self._due[name] = due
        asyncio.get_running_loop().call_later((due - now) / SECOND, obey, given)
        return None

    def _remember(self, name: str, value: Any) -> None:
        if name not in self.kinds:
            raise InputError(f"signal {name!r}: expected one of {', '.join(self.kinds)}")
        self._newest[name] = value
        if isinstance(value, int | float):
            self._greatest[name] = max(self._greatest.get(name, 0.0), abs(value))

    def _neighbour(self, name: str) -> str | None:
        """Return the next signal of the same kind; None if there is no other."""
        alike = [other for other, kind in self.kinds.items() if kind is self.kinds[name]]
        following = alike[(alike.index(name) + 1) % len(alike)]
        return None if following == name else following
