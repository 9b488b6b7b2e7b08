"""Worker processes: state, deadline, death, order on the virtual clock, and no zombies."""

import asyncio
import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from monstertruck_estimation.consistency.service import TARGET as SCAN_ODOMETRY
from monstertruck_estimation.points.service import TARGET as READER
from monstertruck_runtime.actors import actor
from monstertruck_runtime.actors import process as process_module
from monstertruck_runtime.actors.actor import WorkerActor, delivery_of
from monstertruck_runtime.actors.process import WorkerProcess
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import WorkerError, WorkerTimeoutError
from monstertruck_runtime.slowness import SlowComputer
from monstertruck_runtime.threads import in_thread
from monstertruckd.tools.install.kernels import WORKERS

ROOT = Path(__file__).parents[4]


def counter(clock, target: str = "Counter", *, latency=0.01, deadline=5.0, **settings) -> WorkerActor:
    return WorkerActor("counter", f"tests.worker_kit:{target}", clock, latency=latency, deadline=deadline, **settings)


async def forked(worker: WorkerActor) -> int:
    """Process number of a worker that may still wait for the fork server."""
    while worker.pid is None:
        await asyncio.to_thread(time.sleep, 0.001)
    return worker.pid


async def ended(pid: int) -> None:
    """Wait for the end of a process; the container's init may not reap, and a zombie has ended, too."""
    async with asyncio.timeout(3):
        while not gone(pid) and "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text():
            await asyncio.sleep(0.01)


@pytest.fixture
def fresh_server() -> Iterator[None]:
    """A fork server without what other tests have imported."""
    process_module._current.kill()
    yield
    process_module._current.kill()


def gone(pid: int) -> bool:
    """No such process, not even as a zombie."""
    return not Path(f"/proc/{pid}").exists()


async def test_a_worker_keeps_its_state_and_gets_arrays():
    async with counter(WallClock()) as worker:
        assert worker.pid is None
        assert [await worker.step(None) for _ in range(3)] == [1, 2, 3]
        array = np.arange(300_000.0)
        np.testing.assert_array_equal(await worker.step({"double": array}), array * 2)
        pid = worker.pid
        assert pid is not None
    assert worker.pid is None
    assert gone(pid)


async def test_a_worker_is_niced_named_single_threaded_and_light(fresh_server: None):
    async with counter(WallClock()) as worker:
        facts = await worker.step("facts")
    assert facts["pid"] != os.getpid()
    assert facts["name"] == "counter"
    assert facts["nice"] >= min(os.nice(0) + 5, 19)
    assert facts["threads"] == "1"
    assert not {"zenoh", "asyncio", "pydantic"} & set(facts["modules"])


async def test_a_worker_finds_the_folder_and_environment_of_its_parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    async with counter(WallClock()) as worker:
        await worker.start()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SET_SINCE", "yes")
    async with counter(WallClock()) as worker:
        facts = await worker.step("facts")
    assert facts["folder"] == str(tmp_path)
    assert facts["environment"]["SET_SINCE"] == "yes"


async def test_the_server_builds_each_kind_of_worker_once_and_a_worker_itself(fresh_server: None):
    for _ in range(2):
        async with counter(WallClock()) as worker:
            assert (await worker.step("facts"))["built"] == 2


def test_the_server_is_niced_while_it_builds(fresh_server: None):
    """Compiling takes minutes on a slow board."""
    building = WorkerProcess("building", "tests.worker_kit:slow_to_build_once")
    server = process_module._current.server()
    niced = 0
    while building.pid is None:
        niced = os.getpriority(os.PRIO_PROCESS, server.pid)
        time.sleep(0.01)
    assert niced >= os.nice(0) + 5
    building.kill()


async def test_the_server_builds_a_kind_that_runs_a_program_beside_workers(fresh_server: None):
    async with counter(WallClock()) as running, counter(WallClock(), "runs_a_program") as worker:
        assert (await running.step("facts"))["built"] == 2
        assert (await worker.step("facts"))["built"] == 3


def test_a_server_reaps_a_worker_whose_end_is_signalled_twice(tmp_path: Path):
    """The second signal comes while the first is handled."""
    script = tmp_path / "twice.py"
    script.write_text(
        textwrap.dedent("""
        import os, signal, time
        from monstertruck_runtime.actors import server

        reaping = server._Server(None)
        signal.signal(signal.SIGCHLD, reaping._reap)
        process = os.fork()
        if process == 0:
            time.sleep(0.1)
            os._exit(0)
        ours, theirs = os.pipe()
        reaping._ends[process] = theirs
        before, signals = os.waitpid, [signal.SIGCHLD]

        def waitpid(*arguments):
            if signals:
                os.kill(os.getpid(), signals.pop())
            return before(*arguments)

        os.waitpid = waitpid
        assert os.read(ours, 8) == server.NUMBER.pack(0)
        assert not reaping._ends
        """)
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, str(script)], env=environment, check=True, timeout=30.0)


def test_a_kind_that_ends_its_process_harms_no_other():
    ending = WorkerProcess("ending", "tests.worker_kit:ends_itself")
    other = WorkerProcess("other", "tests.worker_kit:Counter")
    with pytest.raises(WorkerError, match=r"^worker ending raised SystemExit: no licence"):
        ending.receive()
    other.receive()
    for worker in (ending, other):
        worker.kill()


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "targets", [(SCAN_ODOMETRY, READER), pytest.param((*WORKERS, SCAN_ODOMETRY, READER), marks=pytest.mark.long)]
)
def test_the_server_of_all_workers_of_a_robot_keeps_one_thread(targets: tuple[str, ...]):
    """A fork of several threads may hang."""
    for target in targets:
        process = WorkerProcess("any", target)
        process.receive()
        process.kill()
    pid = process_module._current.server().pid
    assert len(list(Path(f"/proc/{pid}/task").iterdir())) == 1


async def test_a_killed_server_is_replaced_and_its_workers_run_on():
    async with counter(WallClock()) as worker, counter(WallClock()) as other:
        assert await worker.step(None) == 1
        server = process_module._current.server()
        os.kill(server.pid, signal.SIGKILL)
        async with asyncio.timeout(10):
            while not server.lost:
                await asyncio.sleep(0.01)
        assert await worker.step(None) == 2
        assert await other.step(None) == 1
        assert process_module._current.server().pid != server.pid
        pid = worker.pid
        await worker.close()
        assert pid is not None
        await ended(pid)


async def test_a_frozen_server_is_replaced_when_a_worker_does_not_start():
    async with counter(WallClock(), start_timeout=0.3) as worker:
        os.kill(process_module._current.server().pid, signal.SIGSTOP)
        with pytest.raises(WorkerTimeoutError, match=r"did not start within 0.3 s"):
            await worker.start()
    async with counter(WallClock()) as worker:
        assert await worker.step(None) == 1


async def test_a_frozen_server_is_replaced_when_it_does_not_confirm_an_end(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(process_module, "_END_TIMEOUT", 0.2)
    async with counter(WallClock()) as worker:
        await worker.start()
        pid, server = worker.pid, process_module._current.server()
        assert pid is not None
        os.kill(server.pid, signal.SIGSTOP)
        await worker.close()
        assert server.lost
        await ended(pid)
        assert await worker.step(None) == 1


async def test_a_start_that_waits_too_long_for_another_kind_lets_the_server_build_it(fresh_server: None):
    building = WorkerProcess("building", "tests.worker_kit:slow_to_build_once")
    async with counter(WallClock(), start_timeout=0.1) as waiting:
        with pytest.raises(WorkerTimeoutError, match=r"did not start within 0.1 s"):
            await waiting.start()
    building.receive()
    building.kill()


def test_a_server_that_builds_need_not_confirm_an_end(fresh_server: None, monkeypatch: pytest.MonkeyPatch):
    """One call of the compiler may take longer; signals wait for its end."""
    monkeypatch.setattr(process_module, "_END_TIMEOUT", 0.1)
    worker = WorkerProcess("any", "tests.worker_kit:Counter")
    worker.receive()
    server = process_module._current.server()
    os.kill(server.pid, signal.SIGSTOP)
    building = WorkerProcess("building", "tests.worker_kit:Counter")
    worker.kill()
    os.kill(server.pid, signal.SIGCONT)
    building.receive()
    building.kill()


@pytest.mark.parametrize("server_too", [False, True])
def test_an_ended_worker_gets_no_signal(server_too: bool, monkeypatch: pytest.MonkeyPatch):
    """Another process may have its number by then."""
    worker = WorkerProcess("any", "tests.worker_kit:Counter")
    worker.receive()
    assert worker.pid is not None
    if server_too:
        process_module._current.server().kill()
    worker.send({"die": 3})
    for end in (worker._connection, worker._end):
        select.select((end,), (), (), 30.0)
    signals: list[object] = []
    monkeypatch.setattr(os, "kill", lambda *words: signals.append(words))
    worker.kill()
    assert signals == []


def test_a_worker_given_up_during_the_imports_of_the_server_is_not_forked(fresh_server: None):
    given_up = WorkerProcess("given up", "tests.worker_kit:slow_to_build_once")
    given_up.kill()
    worker = WorkerProcess("next", "tests.worker_kit:Counter")
    worker.receive(10.0)
    server = process_module._current.server()
    forks = Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text().split()
    assert forks == [str(worker.pid)]
    worker.kill()


async def test_concurrent_steps_are_taken_in_order():
    async with counter(WallClock()) as worker:
        assert await asyncio.gather(*(worker.step(None) for _ in range(5))) == [1, 2, 3, 4, 5]


async def test_a_hung_worker_is_killed_at_its_deadline_and_never_hurts_the_loop():
    clock = WallClock()
    late = []

    async def tick() -> None:
        while True:
            due = clock.now() + 5_000_000
            await clock.sleep_until(due)
            late.append(clock.now() - due)

    async with counter(clock, deadline=0.3) as worker:
        await worker.start()
        pid = worker.pid
        assert pid is not None
        ticking = asyncio.create_task(tick())
        start = clock.now()
        with pytest.raises(WorkerTimeoutError, match=r"counter missed its deadline of 0.3 s"):
            await worker.step({"sleep": 60})
        took = (clock.now() - start) / SECOND
        ticking.cancel()
        assert 0.3 <= took < 0.6
        assert gone(pid)
        assert sorted(late)[len(late) // 2] < 30_000_000
        assert len(late) > 5
        assert await worker.step(None) == 1  # a fresh one


async def test_a_stopped_worker_is_killed_too():
    async with counter(WallClock(), deadline=0.2) as worker:
        await worker.start()
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGSTOP)
        with pytest.raises(WorkerTimeoutError):
            await worker.step({"double": np.zeros(1_000_000)})


async def test_a_worker_that_dies_or_raises_is_replaced():
    async with counter(WallClock()) as worker:
        assert await worker.step(None) == 1
        with pytest.raises(WorkerError, match=r"is gone: it ended with exit code 3$"):
            await worker.step({"die": 3})
        assert await worker.step(None) == 1
        with pytest.raises(WorkerError, match=r"^worker counter raised ValueError: no path\nTraceback"):
            await worker.step({"raise": "no path"})
        assert await worker.step(None) == 1
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGKILL)
        with pytest.raises(WorkerError, match=r"is gone: killed by SIGKILL, as by the out-of-memory killer$"):
            await worker.step(None)
        assert await worker.step(None) == 1


async def test_a_factory_that_fails_is_an_error_with_its_text():
    async with counter(WallClock(), "broken") as worker:
        for _ in range(2):
            with pytest.raises(WorkerError, match="no model file"):
                await worker.start()
            assert worker.pid is None


async def test_a_start_takes_no_longer_than_its_timeout():
    async with counter(WallClock(), "slow_to_build", start_timeout=0.3) as worker:
        with pytest.raises(WorkerTimeoutError, match=r"did not start within 0.3 s"):
            await worker.step(None)
    async with counter(WallClock(), "nothing_here") as worker:
        with pytest.raises(WorkerError, match="nothing_here"):
            await worker.step(None)


@pytest.mark.parametrize("after", [0.0, 0.001, 0.3])
async def test_a_cancelled_step_leaves_no_process(after: float):
    worker = counter(WallClock())
    step = asyncio.create_task(worker.step({"sleep": 60}))
    await asyncio.sleep(after)
    pid = worker.pid
    step.cancel()
    with pytest.raises(asyncio.CancelledError):
        await step
    assert worker.pid is None
    assert pid is None or gone(pid)


async def test_closing_under_a_step_fails_it():
    worker = counter(WallClock())
    await worker.start()
    step = asyncio.create_task(worker.step({"sleep": 60}))
    await asyncio.sleep(0.05)
    await worker.close()
    await worker.close()
    with pytest.raises(WorkerError):
        await step


@pytest.mark.parametrize("builds", [False, True])
async def test_a_worker_and_the_server_end_with_their_killed_parent(builds: bool, tmp_path: Path):
    parent = tmp_path / "parent.py"
    parent.write_text(
        textwrap.dedent("""
        import asyncio
        import sys
        from monstertruck_runtime.clock import WallClock
        from monstertruck_runtime.actors.actor import WorkerActor
        from monstertruck_runtime.actors.process import WorkerProcess, _current

        async def main():
            worker = WorkerActor("w", "tests.worker_kit:Counter", WallClock(), latency=1, deadline=99)
            await worker.start()
            building = [WorkerProcess("b", f"tests.worker_kit:slow_to_build{once}") for once in sys.argv[1:]]
            print(worker.pid, _current.server().pid, flush=True)
            await worker.step({"sleep": 60})

        asyncio.run(main())
        """)
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, str(parent), *(["", "_once"] if builds else [])]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    with process:
        assert process.stdout is not None
        processes = [int(word) for word in process.stdout.readline().split()]
        await asyncio.sleep(0.05)
        process.kill()
    for pid in processes:
        await ended(pid)


def test_a_stopped_worker_on_the_virtual_clock_is_killed_too():
    async def main(clock: VirtualClock) -> int:
        async with counter(clock, answer_timeout=2.0) as worker:
            await worker.step(None)
            pid = worker.pid
            assert pid is not None
            os.kill(pid, signal.SIGSTOP)
            with pytest.raises(WorkerError):
                await worker.step({"double": np.zeros(1_000_000)})
            assert gone(pid)
            return await worker.step(None)

    assert run_virtual(main) == 1


def test_on_the_virtual_clock_a_result_comes_exactly_at_its_declared_latency():
    async def main(clock: VirtualClock) -> list[tuple[int, int]]:
        got = []
        SlowComputer(clock, 2.5)
        async with counter(clock, latency=0.2) as worker:
            for seconds in (0.05, 0.0):
                start = clock.now()
                got.append((await worker.step({"sleep": seconds}), clock.now() - start))
        return got

    (first, one), (second, two) = run_virtual(main)
    assert (first, second) == (1, 2)
    assert one == pytest.approx(0.5 * SECOND, abs=5)
    assert two == pytest.approx(0.5 * SECOND, abs=5)


def test_results_due_together_come_in_the_order_of_submission_whatever_the_processes_do():
    async def main(clock: VirtualClock) -> list[tuple[str, int]]:
        order: list[tuple[str, int]] = []

        async def ask(worker: WorkerActor, name: str, begin: float, seconds: float) -> None:
            await clock.sleep(begin)
            await worker.step({"sleep": seconds})
            order.append((name, clock.now()))

        workers = [counter(clock, latency=latency) for latency in (0.3, 0.2, 0.1, 0.2)]
        try:
            await asyncio.gather(
                ask(workers[3], "d", 0.1, 0.0),
                ask(workers[0], "a", 0.0, 0.2),
                ask(workers[2], "c", 0.2, 0.1),
                ask(workers[1], "b", 0.1, 0.0),
            )
        finally:
            for worker in workers:
                await worker.close()
        return order

    one, two = run_virtual(main), run_virtual(main)
    assert one == two
    assert [name for name, _ in one] == ["a", "d", "b", "c"]


def test_too_slow_a_computer_misses_the_deadline_on_the_virtual_clock():
    async def main(clock: VirtualClock) -> float:
        SlowComputer(clock, 3.0)
        async with counter(clock, latency=0.2, deadline=0.5) as worker:
            start = clock.now()
            with pytest.raises(WorkerTimeoutError):
                await worker.step(None)
            return (clock.now() - start) / SECOND

    assert run_virtual(main) == pytest.approx(0.5, abs=1e-6)


def test_a_hang_on_the_virtual_clock_ends_at_the_deadline_too():
    async def main(clock: VirtualClock) -> tuple[float, int]:
        async with counter(clock, latency=0.2, deadline=0.5, answer_timeout=2.0) as worker:
            start = clock.now()
            with pytest.raises(WorkerTimeoutError):
                await worker.step({"sleep": 60})
            took = (clock.now() - start) / SECOND
            with pytest.raises(WorkerError, match="is gone"):
                await worker.step({"die": 1})
            return took, await worker.step(None)

    assert run_virtual(main) == (pytest.approx(0.5, abs=1e-6), 1)


def test_a_worker_that_stops_in_the_middle_of_its_answer_ends_at_the_deadline_too():
    async def main(clock: VirtualClock) -> float:
        async with counter(clock, "Stopping", latency=0.2, deadline=0.5, answer_timeout=0.5) as worker:
            start = clock.now()
            with pytest.raises(WorkerTimeoutError, match="missed its deadline"):
                await worker.step(None)
            assert worker.pid is None
            return (clock.now() - start) / SECOND

    assert run_virtual(main) == pytest.approx(0.5, abs=1e-6)


def test_a_start_that_hangs_or_fails_on_the_virtual_clock():
    async def main(clock: VirtualClock) -> None:
        async with counter(clock, "slow_to_build", start_timeout=0.3) as worker:
            with pytest.raises(WorkerTimeoutError, match="did not start"):
                await worker.step(None)

    run_virtual(main)


@pytest.mark.parametrize(
    ("target", "error"), [("slow_to_build", WorkerTimeoutError), ("broken", WorkerError), ("Counter", None)]
)
def test_on_the_virtual_clock_a_worker_starts_while_the_run_goes_on(target: str, error: type[Exception] | None):
    async def main(clock: VirtualClock) -> None:
        async with counter(clock, target, start_timeout=0.3 if target == "slow_to_build" else 30.0) as worker:
            await worker.start()
            await worker.start()
            if error is None:
                pid = await forked(worker)
                assert await worker.step(None) == 1
                assert worker.pid == pid
                return
            with pytest.raises(error):
                await worker.step(None)
            assert worker.pid is None

    run_virtual(main)


def test_results_due_together_are_delivered_in_the_order_of_waiting_and_cancelled_ones_are_skipped():
    async def main(clock: VirtualClock) -> list[int]:
        delivery = delivery_of(clock)
        assert delivery is delivery_of(clock)
        delivered: list[int] = []
        same = clock.now() + SECOND

        async def wait(number: int, due: int) -> None:
            await delivery.wait(clock, due)
            assert clock.now() == pytest.approx(due, abs=10)
            delivered.append(number)

        tasks = [asyncio.create_task(wait(number, same)) for number in range(50)]
        tasks += [asyncio.create_task(wait(99, same - 1000)), asyncio.create_task(wait(100, same + 1000))]
        await clock.sleep(0.5)
        tasks[7].cancel()
        await asyncio.wait(tasks)
        return delivered

    assert run_virtual(main) == [99, *(number for number in range(50) if number != 7), 100]


async def test_a_busy_worker_takes_no_place_from_other_blocking_work(monkeypatch: pytest.MonkeyPatch):
    """A computer of two cores has six such places: fewer than a full robot has workers."""
    answer = threading.Event()

    class Process:
        pid = 1

        def __init__(self, *_: object) -> None:
            pass

        def receive(self) -> None:
            pass

        def exchange(self, _: object) -> None:
            answer.wait()

        def kill(self) -> None:
            answer.set()

    monkeypatch.setattr(actor, "WorkerProcess", Process)
    asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
    async with counter(WallClock()) as worker:
        await worker.start()
        step = asyncio.create_task(worker.step(None))
        await asyncio.sleep(0.01)
        other = asyncio.create_task(in_thread(lambda: "stored"))
        done, _ = await asyncio.wait([other], timeout=2.0)
        answer.set()
        await asyncio.wait([other, step])
        assert done == {other}
