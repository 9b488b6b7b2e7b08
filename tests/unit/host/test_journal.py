"""What is logged is on the bus as well, by the daemon's clock, without ever waiting or never ending."""

import asyncio
import logging
import threading

import pytest

from monstertruck_runtime.clock import SECOND, WallClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.event import LogLevel
from monstertruck_schemas.topics import Writer
from monstertruckd.bus.local import Bus
from monstertruckd.host.journal import JOURNAL_QUEUE, Journal, published
from monstertruckd.host.logging_queue import LONGEST_RECORD

log = logging.getLogger("monstertruckd.test")


@pytest.fixture(autouse=True)
def info(caplog):
    with caplog.at_level(logging.INFO):
        yield


class Bench:
    def __init__(self, clock, *, reproducible):
        self.clock = clock
        self.bus = Bus(clock)
        self.out = self.bus.publisher(topics.LOG, Writer.DAEMON)
        self.inbox = self.bus.subscribe(topics.LOG, fifo(10_000))
        self.reproducible = reproducible

    def journal(self):
        return published(self.clock, self.out, self.bus.add_drops, reproducible=self.reproducible)


def on_bench(scenario, *, reproducible=True):
    async def main(clock):
        bench = Bench(clock, reproducible=reproducible)
        await scenario(bench)
        return bench

    return run_virtual(main)


def test_records_carry_the_daemons_time_level_and_place():
    async def scenario(bench):
        with bench.journal():
            await bench.clock.sleep(2.0)
            log.warning("lidar: %d scans lost", 3)
            await bench.clock.sleep(1.0)
            try:
                raise ValueError("password=hunter2")
            except ValueError:
                log.exception("bug")
            log.debug("not on this level")
            log.critical("the end")
            await bench.clock.sleep(0.1)
        log.info("after the end")
        await bench.clock.sleep(0.1)
        first, second, third = bench.inbox.drain()
        assert (first.level, first.name, first.text) == (LogLevel.WARNING, "monstertruckd.test", "lidar: 3 scans lost")
        assert first.stamp / SECOND == pytest.approx(3.0)
        assert (first.file, first.seq, third.seq) == ("test_journal.py", 0, 2)
        assert first.line > 0
        assert second.text.startswith("bug\nTraceback")
        assert second.text.endswith("ValueError: password=***")
        assert third.level is LogLevel.FATAL

    on_bench(scenario)


def test_two_virtual_runs_are_equal_whatever_other_threads_log():
    async def scenario(bench):
        with bench.journal():
            for number in range(5):
                thread = threading.Thread(target=log.warning, args=("from a thread %d", number))
                thread.start()
                log.info("from the loop %d", number)
                await bench.clock.sleep(0.1)
                thread.join()
        bench.kept = [(record.stamp, record.text) for record in bench.inbox.drain()]

    runs = [on_bench(scenario).kept for _ in range(2)]
    assert runs[0] == runs[1]
    assert [text for _, text in runs[0]] == [f"from the loop {number}" for number in range(5)]


def test_threads_are_heard_on_the_wall_clock():
    async def main():
        bench = Bench(WallClock(), reproducible=False)
        with bench.journal():
            thread = threading.Thread(target=log.error, args=("recorder: no space left",))
            thread.start()
            thread.join()
            record = await bench.inbox.next()
        assert (record.level, record.text) == (LogLevel.ERROR, "recorder: no space left")
        assert record.received >= record.stamp

    asyncio.run(main())


def test_a_reader_that_logs_does_not_hear_itself_for_ever():
    async def scenario(bench):
        bench.bus.listen(topics.LOG, lambda record: log.error("could not send %r", record.text))
        with bench.journal():
            log.warning("once")
            await bench.clock.sleep(1.0)
        assert [record.text for record in bench.inbox.drain()] == ["once"]

    on_bench(scenario)


def test_a_wrong_log_call_is_not_a_failure_of_who_made_it(capsys):
    async def scenario(bench):
        journal = Journal(bench.clock, bench.out, bench.bus.add_drops, reproducible=True)
        for text, arguments in (("%d scans", ("three",)), ("goes on", ())):
            journal.handle(logging.LogRecord(log.name, logging.ERROR, __file__, 1, text, arguments, None))
        await bench.clock.sleep(0.1)
        assert [record.text for record in bench.inbox.drain()] == ["goes on"]

    on_bench(scenario)
    assert "Logging error" in capsys.readouterr().err


def test_a_burst_is_bounded_loses_the_least_and_counts_it():
    async def scenario(bench):
        with bench.journal():
            log.error("first")
            for number in range(JOURNAL_QUEUE + 50):
                log.info("%d", number)
            await bench.clock.sleep(1.0)
        records = bench.inbox.drain()
        assert len(records) == JOURNAL_QUEUE
        assert records[0].text == "first", "the lowest level goes first"
        assert bench.bus.drops == 51

    on_bench(scenario)


def test_long_records_are_cut():
    async def scenario(bench):
        with bench.journal():
            log.info("x" * (LONGEST_RECORD + 7))
            await bench.clock.sleep(0.1)
        (record,) = bench.inbox.drain()
        assert len(record.text) < LONGEST_RECORD + 40
        assert record.text.endswith(" ... 7 characters more")

    on_bench(scenario)
