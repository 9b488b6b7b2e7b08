"""Services, their supervision, and their nested scopes.

A service's ``run`` owns ONE session: it opens its resource, calls ``ready()`` when it works, serves until
cancelled, and raises when the session is lost. It never reconnects: ``supervise`` runs it again by a
``RestartPolicy``. Only ``TruckError`` is a reason to retry; anything else is a bug.

Scopes start outside-in and stop inside-out. ``asyncio.TaskGroup`` cancels its members at once and in arbitrary order,
so the recorder could end before the last neutral command was written. Here a failing service only interrupts the owner
of the scopes; then every scope ends its services, latest first and each completely, before the scope around it
ends any.
"""

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from enum import StrEnum
from typing import Annotated, Any, Final, Protocol
from weakref import WeakSet

import numpy as np
from pydantic import Field

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DamagedFileError, DeviceMismatchError, PortBusyError, TruckError
from monstertruck_runtime.ports import Ready
from monstertruck_schemas.base import Schema
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason

log = logging.getLogger(__name__)

_ENDING: Final[WeakSet[asyncio.Task[None]]] = WeakSet()
"""Services ended by their scope. ``Task.cancelling`` may count one too many: in Python 3.11 a ``TaskGroup`` leaves one
behind if a member fails while the group waits for its members.
"""


class Service(Protocol):
    """One supervised activity."""

    name: str

    async def run(self, ready: Ready) -> None:
        """Serve one session until cancelled; raise ``TruckError`` when it is lost."""


class OnBug(StrEnum):
    """Consequence of an unexpected exception in a service."""

    EXIT = "exit"
    """For gate, actuators and the bridge to Zenoh: the process must end."""
    FAIL = "fail"
    """For all others: stop the truck through the gate and fail only this service."""


class RestartPolicy(Schema):
    """When to retry a lost session."""

    first_delay: Annotated[float, Field(ge=0)] = 0.1
    """Seconds before the first retry."""
    factor: Annotated[float, Field(ge=1)] = 1.6
    """Growth of the delay from one retry to the next."""
    max_delay: Annotated[float, Field(gt=0)] = 1.0
    """Maximum time between two attempts (s): a replugged device is back within this time."""
    jitter: Annotated[float, Field(ge=0, le=0.5)] = 0.1
    """Random fraction of the delay, so that devices of one hub do not start together."""
    settled_after: Annotated[float, Field(ge=0)] = 5.0
    """Working time that resets the delay (s)."""
    budget: Annotated[int, Field(ge=1)] | None = None
    """Number of restarts allowed within ``window`` seconds before the service fails; None: unlimited."""
    window: Annotated[float, Field(gt=0)] = 60.0
    """Time in which ``budget`` is counted (s)."""


HealthSink = Callable[[ServiceHealth], None]


async def supervise(
    service: Service,
    policy: RestartPolicy,
    clock: Clock,
    report: HealthSink,
    rng: np.random.Generator,
    on_bug: OnBug = OnBug.FAIL,
) -> None:
    """Run ``service`` repeatedly by ``policy`` until cancelled, reporting its health.

    A session lost while its scope ends is not retried. A service that returns, or ends by another task's cancellation,
    is a bug, just as an unexpected exception.

    Args:
        service: service to run.
        policy: delays and budget.
        clock: source of time.
        report: called with a row whenever the state changes.
        rng: source of the jitter.
        on_bug: whether an exception outside the error tree is raised or only fails this service.

    Raises:
        RuntimeError: a bug, when ``on_bug`` is ``EXIT``.
        PortBusyError: another process holds its port at the very first start, when ``on_bug`` is ``EXIT``.
    """
    session = _Session(service.name, clock, report)
    restarts: deque[int] = deque()
    delay = policy.first_delay
    while True:
        session.start()
        try:
            await _serve(service, session.ready)
        except TruckError as error:
            lost = error
        except (Exception, asyncio.CancelledError) as error:
            if isinstance(error, asyncio.CancelledError) and _asked_to_end():
                session.report_state(ServiceState.STOPPED)
                raise
            session.report_state(ServiceState.FAILED, Reason.INTERNAL, "unexpected exception, see the log")
            log.exception("%s: bug", service.name)
            if on_bug is OnBug.EXIT:
                raise RuntimeError(f"{service.name} failed") from error
            return
        else:
            session.report_state(ServiceState.FAILED, Reason.INTERNAL, "ended by itself")
            log.error("%s: bug: ended by itself", service.name)
            if on_bug is OnBug.EXIT:
                raise RuntimeError(f"{service.name} ended by itself")
            return

        if isinstance(lost, PortBusyError) and on_bug is OnBug.EXIT and session.starts == 1:
            # Two daemons must not compete for the same actuators.
            session.report_state(ServiceState.FAILED, lost.reason, str(lost))
            raise PortBusyError(f"{service.name}: {lost}")
        detail = str(lost) or type(lost).__name__
        session.log_loss(lost.reason, detail)
        now = clock.now()
        restarts.append(now)
        while now - restarts[0] > policy.window * SECOND:
            restarts.popleft()
        exhausted = policy.budget is not None and len(restarts) > policy.budget
        if exhausted or isinstance(lost, DeviceMismatchError | DamagedFileError):
            session.report_state(ServiceState.FAILED, lost.reason, detail)
            log.error("%s: given up: %s", service.name, detail)
            return
        if session.ready_at is not None and now - session.ready_at >= policy.settled_after * SECOND:
            delay = policy.first_delay
        session.report_state(ServiceState.BACKOFF, lost.reason, detail)
        del lost  # its traceback refers to the whole session, and to this frame
        await clock.sleep(delay * (1 + policy.jitter * float(rng.uniform(-1, 1))))
        delay = min(delay * policy.factor, policy.max_delay)


async def _serve(service: Service, ready: Ready) -> None:
    """Run one session; an error while its scope ends does not replace the cancellation."""
    try:
        await service.run(ready)
    except TruckError as error:
        if asyncio.current_task() not in _ENDING:
            raise
        log.warning("%s: while it ended: %s", service.name, str(error) or type(error).__name__)
        raise asyncio.CancelledError from error


def _asked_to_end() -> bool:
    """Whether this task itself was cancelled, rather than a task that it awaits."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


class _Session:
    """Health record of the service's current run."""

    def __init__(self, name: str, clock: Clock, report: HealthSink) -> None:
        self._name = name
        self._clock = clock
        self._report = report
        self.starts = 0
        self.ready_at: int | None = None
        self._warned: set[Reason] = set()
        """Causes of the current outage already logged as warnings."""

    def start(self) -> None:
        self.starts += 1
        self.ready_at = None
        self.report_state(ServiceState.STARTING)

    def ready(self) -> None:
        if self.ready_at is None:
            self.ready_at = self._clock.now()
            self._warned.clear()
            self.report_state(ServiceState.READY)
            log.info("%s: ready", self._name)

    def log_loss(self, reason: Reason, detail: str) -> None:
        """Log the first loss of an outage, and every new cause, as a warning; log repetitions at a lower level."""
        log.log(logging.DEBUG if reason in self._warned else logging.WARNING, "%s: %s", self._name, detail)
        self._warned.add(reason)

    def report_state(self, state: ServiceState, reason: Reason = Reason.OK, detail: str = "") -> None:
        self._report(
            ServiceHealth(
                name=self._name,
                state=state,
                since=self._clock.now(),
                restarts=self.starts - 1,
                reason=reason,
                detail=detail,
            )
        )


class Scope:
    """Services that live and end together; created by ``scope``."""

    def __init__(self, name: str) -> None:
        owner = asyncio.current_task()
        assert owner is not None
        self.name = name
        self.failures: list[BaseException] = []
        self._owner = owner
        self._tasks: list[asyncio.Task[None]] = []
        self.interrupted = False
        self._ending = False

    def start(self, name: str, service: Coroutine[Any, Any, None]) -> None:
        """Run ``service`` until the scope ends; its exception ends this scope and all scopes inside."""
        task = asyncio.create_task(service, name=f"{self.name}/{name}")
        task.add_done_callback(self._done)
        self._tasks.append(task)

    async def end(self) -> bool:
        """End all services, latest first, one at a time, even if the owner is cancelled meanwhile.

        Returns:
            True if another task cancelled the owner meanwhile; the cancellation must still be delivered.
        """
        self._ending = True
        disturbed = False
        for task in reversed(self._tasks):
            _ENDING.add(task)
            task.cancel()
            while not task.done():
                try:
                    await asyncio.wait([task])
                except asyncio.CancelledError:
                    disturbed = True
        if self.interrupted:
            self._owner.uncancel()
        return disturbed

    def _done(self, task: asyncio.Task[None]) -> None:
        if task.cancelled() or (error := task.exception()) is None:
            return
        self.failures.append(error)
        if not self.interrupted and not self._ending:
            self.interrupted = True
            self._owner.cancel()


@asynccontextmanager
async def scope(name: str) -> AsyncIterator[Scope]:
    """Open a scope; on exit its services are cancelled one by one, latest first, each awaited.

    Raises:
        BaseExceptionGroup: exceptions of its services and of the body.
    """
    opened = Scope(name)
    raised: list[BaseException] = []
    try:
        yield opened
    except BaseException as error:
        disturbed = await opened.end()
        own = opened.interrupted and isinstance(error, asyncio.CancelledError)
        if not own:
            raised.append(error)
        if not opened.failures:
            raise
    else:
        disturbed = await opened.end()
    if opened.failures:
        raise BaseExceptionGroup(f"scope {name}", [*raised, *opened.failures])
    if disturbed:
        raise asyncio.CancelledError
