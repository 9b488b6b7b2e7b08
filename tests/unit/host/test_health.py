"""The health board: what a service that works suffers from."""

import asyncio
import logging
from types import SimpleNamespace

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import RecorderHealth, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruckd.host.health import HealthBoard, MeterService
from tests.unit.drivers.kit import Events, Kept


def event(reason: Reason, severity: Severity, source: str = "drive") -> Event:
    return Event(stamp=1, received=1, seq=0, reason=reason, severity=severity, source=source, text="answers take 40 ms")


def row(state: ServiceState, name: str = "drive", reason: Reason = Reason.OK) -> ServiceHealth:
    return ServiceHealth(name=name, state=state, since=0, reason=reason)


def after(*reports: ServiceHealth | Event) -> dict[str, tuple[Reason, str]]:
    """Reason and detail of every service in the newest table."""

    async def main(clock: VirtualClock) -> dict[str, tuple[Reason, str]]:
        out = Kept()
        board = HealthBoard(clock, out, Events())
        for report in reports:
            (board.report if isinstance(report, ServiceHealth) else board.observe_event)(report)
        return {row.name: (row.reason, row.detail) for row in out.kept[-1].services}

    return run_virtual(main)


SLOW = event(Reason.SLOW_LINK, Severity.WARNING)
READY = row(ServiceState.READY)


def test_a_slow_link_is_named_in_the_row_of_its_service_alone():
    table = after(READY, row(ServiceState.READY, "lidar"), SLOW)
    assert table == {"drive": (Reason.SLOW_LINK, "answers take 40 ms"), "lidar": (Reason.OK, "")}


def test_one_that_was_found_at_the_start_is_named_when_the_service_is_ready():
    assert after(row(ServiceState.STARTING), SLOW)["drive"] == (Reason.OK, "")
    assert after(row(ServiceState.STARTING), SLOW, READY)["drive"][0] is Reason.SLOW_LINK


def test_it_is_forgotten_when_the_link_is_quick_again_or_the_service_starts_anew():
    assert after(READY, SLOW, event(Reason.SLOW_LINK, Severity.INFO))["drive"] == (Reason.OK, "")
    assert after(READY, SLOW, row(ServiceState.STARTING), READY)["drive"] == (Reason.OK, "")


@pytest.mark.parametrize("reason", [Reason.FILE_DAMAGED, Reason.LOG_DAMAGED])
def test_a_damaged_file_is_named_until_the_daemon_ends(reason):
    found, other = event(reason, Severity.WARNING), event(reason, Severity.INFO)
    assert after(found, row(ServiceState.STARTING), READY)["drive"][0] is reason
    assert after(READY, found, other)["drive"][0] is reason, "another file is sound"
    assert after(READY, other)["drive"][0] is Reason.OK
    assert after(READY, found, SLOW)["drive"][0] is Reason.SLOW_LINK
    assert after(READY, found, SLOW, event(Reason.SLOW_LINK, Severity.INFO))["drive"][0] is reason


def test_a_loss_is_worse_and_other_events_are_no_state():
    lost = row(ServiceState.BACKOFF, reason=Reason.DEVICE_LOST)
    assert after(READY, SLOW, lost)["drive"][0] is Reason.DEVICE_LOST
    assert after(READY, event(Reason.DEVICE_FAULT, Severity.WARNING))["drive"][0] is Reason.OK


def test_another_cause_of_an_outage_and_its_end_without_success_are_events():
    """Unplugged, then another device in its place, then the right one with wrong parameters."""

    async def main(clock: VirtualClock) -> list[tuple[Reason, Severity]]:
        events = Events()
        board = HealthBoard(clock, Kept(), events)
        lost, wrong = (row(ServiceState.BACKOFF, reason=it) for it in (Reason.DEVICE_LOST, Reason.DEVICE_WRONG))
        mismatch = row(ServiceState.FAILED, reason=Reason.DEVICE_MISMATCH)
        for report in (lost, lost, wrong, lost, wrong, mismatch):
            board.report(row(ServiceState.STARTING))
            board.report(report)
        return [(reason, severity) for reason, severity, *_ in events.kept]

    assert run_virtual(main) == [
        (Reason.DEVICE_LOST, Severity.WARNING),
        (Reason.DEVICE_WRONG, Severity.WARNING),
        (Reason.DEVICE_MISMATCH, Severity.ERROR),
    ]


@pytest.mark.parametrize(
    ("lidar", "expected"),
    [
        (ServiceState.READY, "all 2 services are ready"),
        (ServiceState.BACKOFF, "1 of 2 services are ready; not ready: lidar (/dev/lidar: not plugged in)"),
    ],
)
def test_five_seconds_after_the_start_the_log_says_once_what_is_not_ready(
    lidar: ServiceState, expected: str, caplog: pytest.LogCaptureFixture
):
    async def main(clock: VirtualClock) -> None:
        board = HealthBoard(clock, Kept(), Events())
        board.report(READY)
        detail = "" if lidar is ServiceState.READY else "/dev/lidar: not plugged in"
        board.report(row(lidar, "lidar").model_copy(update={"detail": detail}))
        running = asyncio.create_task(board.run(lambda: None))
        await clock.sleep(4.9)
        assert not caplog.messages
        await clock.sleep(20)
        running.cancel()

    caplog.set_level(logging.INFO, "monstertruckd")
    run_virtual(main)
    assert caplog.messages == [expected]


def test_what_only_starts_is_no_warning_and_the_log_says_when_the_last_one_is_ready(caplog: pytest.LogCaptureFixture):
    async def main(clock: VirtualClock) -> None:
        board = HealthBoard(clock, Kept(), Events())
        board.report(READY)
        board.report(row(ServiceState.STARTING, "goals"))
        running = asyncio.create_task(board.run(lambda: None))
        await clock.sleep(20)
        board.report(row(ServiceState.READY, "goals"))
        await clock.sleep(20)
        running.cancel()

    caplog.set_level(logging.INFO, "monstertruckd")
    run_virtual(main)
    assert [(record.levelname, record.message) for record in caplog.records if "services" in record.message] == [
        ("INFO", "1 of 2 services are ready; not ready: goals (starting)"),
        ("INFO", "all 2 services are ready"),
    ]


def test_a_busy_computer_is_said_in_the_log_once_it_lasts(caplog: pytest.LogCaptureFixture):
    def said(late: list[float]) -> list[str]:
        caplog.clear()
        rest = iter(late)

        async def main(clock: VirtualClock) -> None:
            gate = SimpleNamespace(lateness=lambda: SimpleNamespace(ticks=1, p50=0.0, p99=next(rest), max=1.0))
            bus = SimpleNamespace(publisher=lambda *_: Kept(), drops=0)
            job = asyncio.create_task(MeterService(clock, gate, None, bus, Events()).run(lambda: None))  # type: ignore[arg-type]
            await clock.sleep(len(late) + 0.5)
            job.cancel()

        run_virtual(main)
        return [record.message for record in caplog.records]

    assert said([0.05, 0.05, 0.001, 0.001, 0.05, 0.05]) == []
    words = "the computer is busy: control ticks come 50 ms late; end other programs"
    assert said([0.05] * 50) == [words]
    assert said([0.05] * 90) == [words] * 2


def test_a_recorder_that_loses_messages_is_reported_once_a_minute():
    events = Events()

    async def main(clock: VirtualClock) -> None:
        gate = SimpleNamespace(lateness=lambda: SimpleNamespace(ticks=1, p50=0.0, p99=0.0, max=0.0))
        lost = iter([0, 0, 5, 9, *[20] * 100])

        def health(seq: int) -> RecorderHealth:
            return RecorderHealth(
                stamp=clock.now(), received=0, seq=seq, recording=clock.now() < 200 * SECOND, drops=next(lost)
            )

        bus = SimpleNamespace(publisher=lambda *_: Kept(), drops=0)
        recorder = SimpleNamespace(health=health)
        job = asyncio.create_task(MeterService(clock, gate, recorder, bus, events).run(lambda: None))  # type: ignore[arg-type]
        await clock.sleep(100)
        job.cancel()

    run_virtual(main, start=0)
    texts = [(reason, text) for reason, _, text, _ in events.kept]
    words = "messages are missing in the log: the disk takes them too slowly"
    assert texts == [(Reason.MESSAGES_DROPPED, f"5 {words}"), (Reason.MESSAGES_DROPPED, f"20 {words}")]


def test_a_recording_that_ended_is_not_a_slow_disk():
    ended = RecorderHealth(stamp=0, received=0, seq=0, recording=False, drops=7, reason=Reason.DISK_FULL)
    assert ended.lost == ""
