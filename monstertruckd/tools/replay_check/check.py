"""Recomputes a log and compares the result with the recorded outputs.

Outputs of services in the daemon's loop follow from the log's messages and their order alone, so they must be equal bit
for bit. So must the estimation worker's outputs, and outputs based on them, in a log of the virtual clock. On the wall
clock the log shows when the worker's results arrived, but not which of two simultaneous inputs it had read: outputs
based on them may differ by 0.02 (SI units), and its own messages are shown, not judged. So are paths to goals, whose
search there was limited by time, not by work, and reports on goals, because most results of their workers are not
recorded.
"""

import asyncio
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from monstertruck_runtime.clock import SECOND, VirtualLoop
from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import BY_NAME, Topic
from monstertruckd.bus.local import TapCallback
from monstertruckd.config.load import load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.recorder.reader import LogMessage
from monstertruckd.tools.logs.messages import first_offset
from monstertruckd.tools.replay_check.chain import WORKER, Chain, outputs_of, unseen_ticks, why_no_goals, without_goals
from monstertruckd.tools.replay_check.comparison import TopicComparison
from monstertruckd.tools.replay_check.pace import PacedClock
from monstertruckd.tools.replay_check.recorded import RunLog, Survey, recorded_config, run_of, survey
from monstertruckd.tools.replay_check.result import CheckedReplay, Unreadable

RESTS_ON_WORKER: Final = frozenset(
    topic.name for topic in (topics.POSE, topics.TRANSFORMS, topics.TRACKER, topics.PLAN_DRIVE)
)
"""Outputs a worker has a say in where the robot maps or localises."""
RESTS_ON_GOALS: Final = frozenset({topics.TRACKER.name, topics.PLAN_DRIVE.name})
"""Outputs a worker has a say in where the robot drives to goals; of the wall clock several stamps of one tick are known
as one."""
GOALS: Final = frozenset({topics.PATH.name, topics.GOAL.name})


def check_log(
    log: Path,
    config: Path | None = None,
    tolerance: float | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> CheckedReplay:
    """Recompute the outputs of ``log`` and compare them.

    Args:
        log: file to read; of a run in several parts any one stands for all, a black box for its run up to its end.
        config: another configuration to use; None: the log's own.
        tolerance: maximum difference that agrees, in SI units, instead of the ones above.
        progress: called with the bytes of the run read so far.

    Raises:
        NotFoundError: no such log, configuration or saved map.
        InputError: the log contains no configuration, no sensors, no outputs, or has no first part.
        ConfigError: a configuration is refused.
        WorkerError: the estimation worker failed.
    """
    log, until = run_of(log)
    reader = RunLog(log, until)
    found = survey(reader)
    attachments = reader.first.attachments()
    own = recorded_config(log, attachments)
    used = own if config is None else load_truck(config)[0]
    left_out = why_no_goals(own, used, found.goals)
    if left_out is not None:
        own, used = without_goals(own), without_goals(used)
    compared = outputs_of(own) | outputs_of(used)
    _refuse_the_middle(log, found, compared)
    virtual = first_offset(log, reader.first.metadata().get("run", {})) == 0
    loose, shown = (frozenset[str](),) * 2 if virtual else _inexact(own, used)
    # Maximum difference, SI units, of outputs based on a worker's, in a log of the wall clock.
    worker_tolerance = 0.02
    comparisons = {
        topic.name: TopicComparison(
            topic,
            tolerance if tolerance is not None else worker_tolerance * (topic.name in loose),
            found.start,
            judged=topic.name not in shown,
        )
        for topic in topics.TOPICS
        if topic.name in compared
    }
    unreadable: list[Unreadable] = []

    async def main(clock: PacedClock) -> None:
        chain = Chain(used, clock, unseen_ticks(own, found), found)
        tap = chain.bus.tap(_into(comparisons, chain), (comparison.topic for comparison in comparisons.values()))
        async with chain.running():
            relevant = (entry for entry in reader if entry.topic in comparisons or chain.takes(entry.topic))
            for bunch in _bunches(relevant, chain.ticks):
                progress(reader.position)
                await _feed(chain, bunch, comparisons, found, unreadable)
            await chain.finish(found.end)
            tap.close()

    with asyncio.Runner(loop_factory=lambda: VirtualLoop(found.start)) as runner:
        loop = runner.get_loop()
        assert isinstance(loop, VirtualLoop)
        runner.run(main(PacedClock(loop)))
    end = max((found.newest[name].log_time for name in compared & found.newest.keys()), default=found.end)
    return CheckedReplay(
        log,
        reader.parts,
        config,
        (found.end - found.start) / SECOND,
        end,
        tuple(comparisons.values()),
        tuple(unreadable),
        found.lost(),
        found.damage,
        left_out,
    )


def _bunches(log: Iterable[LogMessage], ticks: Callable[[LogMessage], bool]) -> Iterator[list[LogMessage]]:
    """Yield messages one at a time, but group consecutive outputs that reveal ticks."""
    bunch: list[LogMessage] = []
    for entry in log:
        ticking = ticks(entry)
        if bunch and not ticking:
            yield bunch
            bunch = []
        bunch.append(entry)
        if not ticking:
            yield bunch
            bunch = []
    if bunch:
        yield bunch


async def _feed(
    chain: Chain,
    bunch: Sequence[LogMessage],
    comparisons: Mapping[str, TopicComparison],
    found: Survey,
    unreadable: list[Unreadable],
) -> None:
    for entry in bunch:
        if (comparison := comparisons.get(entry.topic)) is not None:
            comparison.recorded(entry.sequence, entry.log_time, entry.payload)
    entry = bunch[0]
    if entry.topic in WORKER:
        await chain.answer(entry)
        return
    if not chain.takes(entry.topic):
        await chain.tick(bunch)
        return
    try:
        message = entry.decode()
    except TruckError as error:
        at = (entry.log_time - found.start) / SECOND
        unreadable.append(Unreadable(entry.topic, entry.sequence, at, str(error)))
    else:
        await chain.take(BY_NAME[entry.topic], message, entry.log_time)


def _into(comparisons: Mapping[str, TopicComparison], chain: Chain) -> TapCallback:
    def take(topic: Topic[Message], message: Message, payload: bytes, at: int) -> None:
        comparisons[topic.name].recomputed(at, chain.as_computed(topic, message, payload))

    return take


def _inexact(*configs: TruckConfig) -> tuple[frozenset[str], frozenset[str]]:
    """Return the topics that may differ a little on the wall clock, and those that are not judged."""
    loose, shown = frozenset[str](), frozenset[str]()
    if any(config.slam is not None for config in configs):
        loose, shown = RESTS_ON_WORKER, shown | frozenset(WORKER)
    if any(config.own_planner is not None for config in configs):
        loose, shown = loose | RESTS_ON_GOALS, shown | GOALS
    return loose, shown


def _refuse_the_middle(log: Path, found: Survey, compared: Collection[str]) -> None:
    outputs = [entry for name, entry in found.first.items() if name in compared and name != topics.SCAN.name]
    if not outputs:
        raise InputError(f"{log}: contains no outputs of estimation to compare")
    for entry in outputs:
        number = entry.decode().seq
        if number > 0:
            text = f"{entry.topic} starts with number {number}: expected the first part of a run, which starts with 0"
            raise InputError(f"{log}: {text}")
