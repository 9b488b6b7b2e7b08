"""Supervision: which failures are retried, when, and what is reported."""

import asyncio
import gc
import weakref
from collections.abc import Callable

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DamagedFileError,
    DeviceLostError,
    DeviceMismatchError,
    PortBusyError,
    TruckError,
    WrongDeviceError,
)
from monstertruck_runtime.ports import Ready
from monstertruck_runtime.service import OnBug, RestartPolicy, scope, supervise
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason

STEADY = RestartPolicy(first_delay=1.0, factor=2.0, max_delay=5.0, jitter=0.0, settled_after=10.0)


class Scripted:
    """A service whose n-th session is the n-th script."""

    name = "scripted"

    def __init__(self, clock: VirtualClock, *scripts: Callable[[Ready], object]) -> None:
        self.clock = clock
        self.scripts = list(scripts)
        self.starts: list[float] = []

    async def run(self, ready: Ready) -> None:
        self.starts.append(self.clock.now() / SECOND)
        result = self.scripts.pop(0)(ready)
        if asyncio.iscoroutine(result):
            await result


def lost(_: Ready) -> None:
    raise DeviceLostError("cable")


def run(*scripts: Callable[[Ready], object], policy: RestartPolicy = STEADY, on_bug: OnBug = OnBug.FAIL):
    health: list[ServiceHealth] = []
    starts: list[float] = []

    async def main(clock: VirtualClock) -> None:
        service = Scripted(clock, *scripts)
        await supervise(service, policy, clock, health.append, np.random.default_rng(1), on_bug)
        starts.extend(service.starts)

    run_virtual(main, start=0)
    return health, starts


def test_lost_sessions_are_tried_again_with_growing_capped_delays():
    health, starts = run(lost, lost, lost, lost, lost, lambda ready: ready())
    assert starts == pytest.approx([0, 1, 3, 7, 12, 17])
    assert [row.state for row in health[-3:]] == [ServiceState.STARTING, ServiceState.READY, ServiceState.FAILED]
    assert health[-1].restarts == 5
    assert {row.reason for row in health if row.state is ServiceState.BACKOFF} == {Reason.DEVICE_LOST}
    assert all(row.detail == "cable" for row in health if row.state is ServiceState.BACKOFF)


def test_a_device_that_is_not_there_at_the_start_is_one_warning(caplog: pytest.LogCaptureFixture):
    run(lost, lost, lost, lambda ready: ready())
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["scripted: cable"]


def test_another_cause_of_the_same_outage_is_a_warning_too(caplog: pytest.LogCaptureFixture):
    def wrong(_: Ready) -> None:
        raise WrongDeviceError("a compass answers")

    run(lost, wrong, lost, wrong, lambda ready: ready())
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == ["scripted: cable", "scripted: a compass answers"]


def test_a_session_that_settled_starts_the_delays_anew():
    async def works_a_while(ready: Ready) -> None:
        ready()
        await asyncio.sleep(20)
        raise DeviceLostError("later")

    _, starts = run(lost, lost, works_a_while, lost, lambda ready: ready())
    assert starts == pytest.approx([0, 1, 3, 24, 26])


@pytest.mark.parametrize(
    ("error", "reason"), [(DeviceMismatchError, Reason.DEVICE_MISMATCH), (DamagedFileError, Reason.FILE_DAMAGED)]
)
def test_a_mismatch_and_a_damaged_file_are_never_retried(error: type[TruckError], reason: Reason):
    def refuse(_: Ready) -> None:
        raise error("motor type 10, expected 1")

    health, starts = run(refuse)
    assert len(starts) == 1
    assert health[-1].state is ServiceState.FAILED
    assert health[-1].reason is reason


def test_an_exhausted_budget_gives_up():
    health, starts = run(*[lost] * 9, policy=RestartPolicy(first_delay=0.1, max_delay=0.1, jitter=0, budget=3))
    assert len(starts) == 4
    assert health[-1].state is ServiceState.FAILED


def bug(_: Ready) -> None:
    raise ZeroDivisionError


def test_a_bug_fails_an_ordinary_service_alone():
    health, _ = run(bug)
    assert health[-1].state is ServiceState.FAILED
    assert health[-1].reason is Reason.INTERNAL


def test_a_bug_in_a_critical_service_is_raised():
    with pytest.raises(RuntimeError, match="scripted failed"):
        run(bug, on_bug=OnBug.EXIT)


def busy(_: Ready) -> None:
    raise PortBusyError("held by another process")


def test_a_critical_service_does_not_lie_in_wait_for_a_busy_port():
    with pytest.raises(PortBusyError, match="scripted: held"):
        run(busy, on_bug=OnBug.EXIT)
    with pytest.raises(PortBusyError):
        run(busy, on_bug=OnBug.EXIT)
    _, starts = run(lost, busy, lost, lambda ready: ready(), on_bug=OnBug.FAIL)
    assert len(starts) == 4, "ordinary services try on"


def test_returning_is_a_bug():
    health, _ = run(lambda ready: ready())
    assert (health[-1].state, health[-1].detail) == (ServiceState.FAILED, "ended by itself")
    with pytest.raises(RuntimeError, match="ended by itself"):
        run(lambda ready: ready(), on_bug=OnBug.EXIT)


def test_somebody_elses_cancellation_is_a_bug():
    async def awaits_a_cancelled_future(ready: Ready) -> None:
        ready()
        future = asyncio.get_running_loop().create_future()
        future.cancel()
        await future

    health, _ = run(awaits_a_cancelled_future)
    assert health[-1].state is ServiceState.FAILED
    with pytest.raises(RuntimeError):
        run(awaits_a_cancelled_future, on_bug=OnBug.EXIT)


def test_cancellation_is_reported_and_passes():
    async def forever(ready: Ready) -> None:
        ready()
        await asyncio.Event().wait()

    health: list[ServiceHealth] = []

    async def main(clock: VirtualClock) -> None:
        task = asyncio.create_task(
            supervise(Scripted(clock, forever), STEADY, clock, health.append, np.random.default_rng(1))
        )
        await clock.sleep(1)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(main)
    assert [row.state for row in health] == [ServiceState.STARTING, ServiceState.READY, ServiceState.STOPPED]


def test_a_session_that_is_lost_while_its_scope_ends_is_not_tried_again():
    async def lost_at_the_last_command(ready: Ready) -> None:
        ready()
        try:
            await asyncio.Event().wait()
        finally:
            raise DeviceLostError("unplugged")

    health: list[ServiceHealth] = []

    async def main(clock: VirtualClock) -> None:
        service = Scripted(clock, lost_at_the_last_command, lambda ready: ready())
        async with scope("actuators") as actuators:
            actuators.start("drive", supervise(service, STEADY, clock, health.append, np.random.default_rng(1)))
            await clock.sleep(1)
        assert service.starts == [0.0]
        assert clock.now() < 1.1 * SECOND

    run_virtual(main, start=0)
    assert [row.state for row in health] == [ServiceState.STARTING, ServiceState.READY, ServiceState.STOPPED]


def test_a_session_whose_task_group_failed_while_it_waited_for_its_members_is_tried_again():
    async def member() -> None:
        await asyncio.sleep(1.0)
        raise DeviceLostError("cable")

    async def group(_: Ready) -> None:
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(member())
        except* DeviceLostError as errors:
            raise errors.exceptions[0] from None

    health: list[ServiceHealth] = []

    async def main(clock: VirtualClock) -> None:
        service = Scripted(clock, group, lambda ready: ready())
        async with scope("estimation") as estimation:
            estimation.start("slam", supervise(service, STEADY, clock, health.append, np.random.default_rng(1)))
            await clock.sleep(5.0)
        assert service.starts == pytest.approx([0.0, 2.0])

    run_virtual(main, start=0)
    assert ServiceState.BACKOFF in {row.state for row in health}


def test_nothing_of_a_lost_session_is_kept_by_its_error():
    kept: list[weakref.ref[set[int]]] = []

    async def session(_: Ready) -> None:
        buffers = {1}
        kept.append(weakref.ref(buffers))
        raise DeviceLostError("cable")

    async def main(clock: VirtualClock) -> None:
        service = Scripted(clock, *[session] * 3)
        report: list[ServiceHealth] = []
        task = asyncio.create_task(supervise(service, STEADY, clock, report.append, np.random.default_rng(1)))
        await clock.sleep(2.0)
        assert len(kept) == 2
        assert [ref() for ref in kept] == [None, None], "freed at once, not by the collector"
        task.cancel()
        await asyncio.wait([task])

    gc.disable()
    try:
        run_virtual(main)
    finally:
        gc.enable()
