import asyncio

import pytest

from monstertruck_runtime.clock import run_virtual
from monstertruck_schemas.topics import EVENT, ODOMETRY, POSE, SCAN
from monstertruckd.bus.outgoing import Outgoing


def call(job):
    job()


def sent(scenario, seconds=0.02, guard=call):
    """Names and milliseconds of what was put."""
    found = []

    async def main(clock):
        outgoing = Outgoing(seconds, guard)
        begin = clock.now()

        def send(topic):
            outgoing.send(
                topic, lambda data: found.append((data.decode(), (clock.now() - begin) // 10**6)), topic.name.encode()
            )

        await scenario(send, outgoing, clock)

    run_virtual(main)
    return found


def test_frequent_messages_wait_for_each_other():
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.005)
        send(POSE)
        await clock.sleep(0.03)
        send(ODOMETRY)
        await clock.sleep(0.1)

    assert sent(scenario) == [("state/odometry", 20), ("state/pose", 20), ("state/odometry", 55)]


@pytest.mark.parametrize("rare", [SCAN, EVENT])
def test_a_rare_message_leaves_at_once_behind_what_waits(rare):
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.005)
        send(rare)
        send(POSE)
        await clock.sleep(0.1)

    assert sent(scenario) == [("state/odometry", 5), (rare.name, 5), ("state/pose", 20)]


def test_nothing_waits_if_it_is_told_so():
    async def scenario(send, _, clock):
        send(ODOMETRY)
        await clock.sleep(0.1)

    assert sent(scenario, seconds=0.0) == [("state/odometry", 0)]


def test_what_waits_at_the_end_is_put():
    async def scenario(send, outgoing, clock):
        send(ODOMETRY)
        outgoing.close()
        await clock.sleep(0.1)

    assert sent(scenario) == [("state/odometry", 0)]


def test_a_failure_of_the_timers_put_is_told():
    told = []

    def guard(job):
        try:
            job()
        except OSError as error:
            told.append(error)

    def refuse(_):
        raise OSError

    async def main(clock):
        outgoing = Outgoing(0.02, guard)
        outgoing.send(ODOMETRY, refuse, b"")
        await asyncio.sleep(0.1)
        outgoing.close()

    run_virtual(main)
    assert len(told) == 1
