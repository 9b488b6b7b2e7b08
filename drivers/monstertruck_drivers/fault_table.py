"""Table of an emulated device's faults."""

from collections.abc import Callable, Mapping

from monstertruck_runtime.errors import InputError

FaultRows = Mapping[str, Callable[..., None] | float]
"""Faults by name and values, such as ``late SECONDS [COUNT]``; names joined by ``|`` share a row."""


class FaultTable:
    """Faults of one device.

    The value of a row starts the fault: either a function, which receives its values as text (``on|off`` as a bool), or
    a number, which the table keeps and the device reads. A ``False`` is a switch, an ``int`` is the number of remaining
    occurrences, a ``float`` is a quantity.

    Args:
        device: device name for messages.
        rows: faults of the device.

    Raises:
        InputError: see ``add``.
    """

    def __init__(self, device: str, rows: FaultRows) -> None:
        self._device = device
        self._acts: dict[str, Callable[..., None]] = {}
        self._usages: dict[str, str] = {}
        """Usage of a row by fault."""
        self._numbers: dict[str, float] = {}
        self.add(rows)

    def add(self, rows: FaultRows) -> None:
        """Add faults to the table.

        Raises:
            InputError: the value of a row is neither a function nor a number.
        """
        for usage, value in rows.items():
            if not callable(value) and not isinstance(value, int | float):
                raise InputError(f"{self._device}: fault {usage}: expected a function or a number, found {value!r}")
            for fault in usage.split()[0].split("|"):
                self._usages[fault] = usage
                if callable(value):
                    self._acts[fault] = value
                else:
                    self._numbers[fault] = value

    def __getitem__(self, fault: str) -> float:
        """Return the number kept for a fault."""
        return self._numbers[fault]

    def __setitem__(self, fault: str, number: float) -> None:
        """Set the number kept for a fault."""
        self._numbers[fault] = number

    def strikes(self, fault: str) -> bool:
        """Return whether a counted fault occurs now, and count it."""
        left = self._numbers[fault]
        self._numbers[fault] = max(left - 1, 0)
        return left > 0

    def start(self, fault: str, *values: str) -> None:
        """Start or end a fault.

        Raises:
            InputError: the device has no such fault, or the values do not fit it.
        """
        known = ", ".join(dict.fromkeys(self._usages.values()))
        if fault not in self._usages:
            raise InputError(f"{self._device}: unknown fault {fault!r}; known: {known}")
        usage = self._usages[fault].split()[1:]
        try:
            if fault in self._acts:
                switches = [word.strip("[]") == "on|off" for word in usage] + [False] * len(values)
                self._acts[fault](*(_on(value) if on else value for on, value in zip(switches, values, strict=False)))
            else:
                self._numbers[fault] = _number(self._numbers[fault], usage, values)
        except (LookupError, TypeError, ValueError) as error:
            expected, got = " ".join((fault, *usage)), " ".join((fault, *values))
            raise InputError(f"{self._device}: expected '{expected}', got {got!r}; known: {known}") from error


class LateAnswers:
    """Fault ``late SECONDS [COUNT]``: the next answers are delayed."""

    def __init__(self) -> None:
        self._delays: list[float] = []

    def start(self, seconds: str, count: str = "1") -> None:
        """Delay the next ``count`` answers by ``seconds``."""
        self._delays = [float(seconds)] * int(count)

    def take(self, usual: float) -> float:
        """Return the delay of the next answer (s): ``usual`` without the fault."""
        return self._delays.pop() if self._delays else usual


class FaultyDevice:
    """Base class of the emulators; injects the faults in its table."""

    faults: FaultTable

    def inject(self, fault: str, *values: str) -> None:
        """Start or end a fault; the class docstring lists the faults.

        Raises:
            InputError: the device has no such fault, or the values do not fit it.
        """
        self.faults.start(fault, *values)


def _on(word: str) -> bool:
    return {"on": True, "off": False}[word]


def _number(before: float, usage: list[str], values: tuple[str, ...]) -> float:
    """Parse the number from the values; without a value, a switch is turned on and a counted fault occurs once."""
    optional = all(word.startswith("[") for word in usage)
    (word,) = ("on" if isinstance(before, bool) else "1",) if optional and not values else values
    if len(values) > len(usage):
        raise ValueError(values)
    if isinstance(before, bool):
        return _on(word)
    if isinstance(before, int) and int(word) < 0:
        raise ValueError(word)
    return type(before)(word)
