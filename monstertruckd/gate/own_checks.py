"""Checks added by a configuration: a fault in one of them stops the robot and never ends the gate."""

import logging
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Cause, Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic
from monstertruckd.gate.catalog import GATE_CHECKS, CheckConfig
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.motion import Course

log = logging.getLogger(__name__)

T = TypeVar("T")


class OwnCheck(Check):
    """A check selected by ``kind``; if it raises, it is disabled and the robot stands until the daemon is restarted.

    Args:
        view: read access to the gate's state.
        name: name of the check in the configuration.
        config: settings of the check.

    Raises:
        InputError: the implementation cannot be loaded.
    """

    def __init__(self, view: GateView, name: str, config: CheckConfig) -> None:
        super().__init__(view)
        self._name = name
        self._check: Check = GATE_CHECKS.build(config, config, view)
        self._error: str | None = None
        self.reasons = tuple(dict.fromkeys((*self._check.reasons, Reason.OWN_CHECK)))
        self.reads = tuple(self._check.reads)

    @property
    def urgent(self) -> bool:
        """See ``Check.urgent``."""
        return self._guarded(lambda: bool(self._check.urgent), default=True)

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """See ``Check.observe``."""
        self._guarded(lambda: self._check.observe(seen, topic), default=None)

    def reason(self, now: int) -> Iterable[Reason]:
        """See ``Check.reason``; also reports that the check failed."""
        given: list[Reason] = self._guarded(lambda: list(map(_known, self._check.reason(now))), default=[])
        return given if self._error is None else [Reason.OWN_CHECK]

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterable[PaceLimit]:
        """See ``Check.limit``."""
        return self._guarded(
            lambda: [PaceLimit(_known(reason), float(pace)) for reason, pace in self._check.limit(now, courses)],
            default=[PaceLimit(Reason.OWN_CHECK, 0.0)],
        )

    def text(self, reason: Reason) -> str:
        """See ``Check.text``; adds the name of the check."""
        said = self._guarded(lambda: str(self._check.text(reason)), default=reason.text)
        return f"{self._name}: {said}" if self._error is None else f"{self._name} failed: {self._error}"

    def figures(self, reason: Reason, now: int) -> Iterable[Measurement]:
        """See ``Check.figures``."""
        return self._guarded(lambda: list(self._check.figures(reason, now)), default=[])

    def describe(self, reason: Reason, now: int, since: int) -> Iterable[Cause]:
        """See ``Check.describe``."""
        described: list[Cause] = self._guarded(lambda: list(self._check.describe(reason, now, since)), default=[])
        return [cause.model_copy(update={"text": self.text(reason)}) for cause in described] or list(
            super().describe(reason, now, since)
        )

    def reset(self) -> None:
        """See ``Check.reset``."""
        self._guarded(self._check.reset, default=None)

    def _guarded(self, ask: Callable[[], T], *, default: T) -> T:
        """Return the answer of the check; ``default`` once it has raised."""
        if self._error is None:
            try:
                return ask()
            except Exception as raised:
                log.exception("the gate's check %s failed", self._name)
                self._error = f"{type(raised).__name__}: {raised}"
        return default


def _known(reason: Reason) -> Reason:
    """Return ``reason`` if it is a ``Reason``; raise TypeError otherwise."""
    if not isinstance(reason, Reason):
        raise TypeError(f"reason {reason!r}: expected a Reason")
    return reason
