import asyncio
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from monstertruck_runtime import small_files
from monstertruck_runtime.clock import SECOND, WallClock, run_virtual
from monstertruck_runtime.threads import inline
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, Order, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.latch import EstopLatch, MemoryLatch, marks_folder
from monstertruckd.gate.service import TickMeter
from tests.unit.gate.bench import Bench, on_bench
from tests.unit.gate.rig import NONCE, header


def test_ticks_stay_on_an_absolute_grid():
    async def scenario(bench):
        await bench.clock.sleep(1.0)

    bench = on_bench(scenario)
    stamps = np.array([message.stamp for message in bench.out.drives[0].messages])[:-1]  # the last one is the farewell
    assert len(stamps) == pytest.approx(56, abs=1)
    assert np.abs((stamps - stamps[0]) - np.arange(len(stamps)) * SECOND // 50).max() < 1000  # ns: no drift
    assert [m.seq for m in bench.out.drives[0].messages] == list(range(len(bench.out.drives[0].messages)))
    assert len(bench.out.steering.messages) == len(bench.out.drives[0].messages)
    assert bench.readies == len(stamps)
    lateness = bench.service.lateness()
    assert lateness.ticks == len(stamps)
    assert 0 <= lateness.p50 <= lateness.p99 <= lateness.max < 1e-5


def test_a_stall_skips_ticks_but_keeps_the_grid():
    async def scenario(bench):
        await bench.clock.sleep(0.1)
        asyncio.get_running_loop().jump(0.105)  # the loop was busy elsewhere
        await bench.clock.sleep(0.2)

    bench = on_bench(scenario)
    stamps = np.array([message.stamp for message in bench.out.drives[0].messages])[:-1]
    assert np.diff(stamps).max() > 0.09 * SECOND
    offsets = (stamps - stamps[0]) % (SECOND // 50)
    late = np.minimum(offsets, SECOND // 50 - offsets) > 1000
    assert late.sum() == 1  # only the one that woke up late
    assert bench.service.lateness().max > 0.08


def test_requests_of_both_kinds_reach_the_gate():
    async def scenario(bench):
        bench.order(Order.ARM)
        await bench.clock.sleep(0.05)
        assert bench.out.state.last.mode is GateMode.ARMED
        assert bench.ask(bench.service.planner_request, Role.TRACKER) is Reason.OK
        await bench.clock.sleep(0.05)
        assert bench.out.state.last.holder == "tracker"
        assert bench.ask(bench.service.request, Role.GAMEPAD) is Reason.OK
        await bench.clock.sleep(0.05)
        assert bench.out.state.last.holder == "gamepad"
        assert bench.out.drives[0].last.speed > 0
        assert bench.out.drives[0].last.action is DriveAction.RUN
        assert bench.out.steering.last.front > 0
        assert bench.out.steering.last.front_servo > bench.out.steering.last.front

    bench = on_bench(scenario)
    assert [reason for reason, *_ in bench.events][:3] == [Reason.ARMED, Reason.DRIVING, Reason.DRIVING]
    assert bench.events[0][1] == "gate"


def test_state_goes_out_on_change_and_ten_times_a_second():
    async def scenario(bench):
        await bench.clock.sleep(0.9)
        quiet = len(bench.out.state.messages)
        assert quiet == pytest.approx(10, abs=2)
        bench.order(Order.ARM)
        await bench.clock.sleep(0.03)
        assert len(bench.out.state.messages) > quiet
        assert bench.out.state.last.nonce == NONCE

    on_bench(scenario)


def test_an_emergency_stop_lowers_the_deadman_line_until_it_is_reset():
    async def scenario(bench):
        assert bench.out.steering.last.deadman
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.05)
        assert not bench.out.steering.last.deadman
        bench.order(Order.RESET)
        await bench.clock.sleep(0.05)
        assert bench.out.steering.last.deadman

    on_bench(scenario)


def test_the_deadman_line_falls_when_the_drive_is_silent_and_rises_with_its_voice():
    async def scenario(bench):
        assert bench.out.steering.last.deadman
        heard, bench.drive.send = bench.drive.send, lambda _: None
        await bench.clock.sleep(0.3)
        assert not bench.out.steering.last.deadman
        bench.drive.send = heard
        await bench.clock.sleep(0.1)
        assert bench.out.steering.last.deadman

    on_bench(scenario)


def test_a_direct_order_is_answered():
    async def scenario(bench):
        now = bench.clock.now()
        order = ControlRequest(
            **header(now), source="rpc", role=Role.TRACKER, lease=1.0, nonce=NONCE, gate_stamp=now, order=Order.ARM
        )
        assert bench.service.control(order) == (Reason.BAD_ROLE, Reason.BAD_ROLE.text)

    on_bench(scenario)


def test_the_last_commands_are_neutral():
    async def scenario(bench):
        bench.order(Order.ARM)
        await bench.clock.sleep(0.05)
        assert bench.ask(bench.service.request, Role.GAMEPAD) is Reason.OK
        await bench.clock.sleep(0.1)
        assert bench.out.drives[0].last.speed > 0

    bench = on_bench(scenario)
    assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP
    assert bench.out.drives[0].last.speed == 0
    assert Reason.SHUTDOWN in bench.out.state.last.reasons


def test_shutting_down_stops_at_once_and_for_good():
    async def scenario(bench):
        bench.order(Order.ARM)
        await bench.clock.sleep(0.05)
        assert bench.ask(bench.service.request, Role.GAMEPAD) is Reason.OK
        await bench.clock.sleep(0.05)
        bench.service.shut_down()
        assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP
        assert bench.ask(bench.service.request, Role.GAMEPAD) is Reason.DISARMED
        await bench.clock.sleep(0.2)
        assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP

    on_bench(scenario)


def raise_bug(*_):
    raise AttributeError


def test_a_bug_in_taking_a_message_ends_the_service_and_not_its_sender():
    async def main(clock):
        for name, default in (
            ("control", Reason.INTERNAL),
            ("request", Reason.INTERNAL),
            ("planner_request", Reason.INTERNAL),
            ("observe_health", None),
        ):
            bench = Bench(clock)
            task = asyncio.create_task(bench.service.run(bench.ready))
            await clock.sleep(0.1)
            bench.service._gate.observe = raise_bug
            answer = getattr(bench.service, name)(None)
            assert getattr(answer, "reason", answer) is default
            begin = clock.now()
            with pytest.raises(ExceptionGroup) as raised:
                await task
            assert [type(bug) for bug in raised.value.exceptions] == [AttributeError], "the bug itself"
            assert clock.now() - begin < SECOND // 1000, "not only at the next tick"
            assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP

    run_virtual(main)


def test_a_bug_ends_the_service_with_neutral_commands():
    async def main(clock):
        bench = Bench(clock)
        bench.service._gate.tick = raise_bug
        with pytest.raises(ExceptionGroup):
            await bench.service.run(bench.ready)
        assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP

    run_virtual(main)


# Latch


def file_latch(folder):
    (folder / "run").mkdir(exist_ok=True)
    latch = EstopLatch(folder / "state" / "estop", folder / "run")
    latch.prepare()
    return latch


def test_an_emergency_stop_survives_a_restart(tmp_path):
    latch = file_latch(tmp_path)

    async def stop(bench):
        bench.order(Order.ESTOP)
        await asyncio.sleep(0.05)
        for _ in range(1000):
            if latch.stored():
                break
            await asyncio.to_thread(lambda: None)
        assert latch.stored()

    on_bench(stop, latch)
    assert list((tmp_path / "run").iterdir()) == [], "a daemon that ends in peace leaves no mark"

    async def restarted(bench):
        assert bench.out.state.last.mode is GateMode.ESTOPPED
        assert bench.out.state.last.latched
        assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP
        bench.order(Order.RESET)
        await asyncio.sleep(0.05)

    latch = file_latch(tmp_path)
    on_bench(restarted, latch)
    assert not latch.engaged()

    async def released(bench):
        assert bench.out.state.last.mode is GateMode.DISARMED
        assert not bench.out.state.last.latched

    on_bench(released, latch)


def test_an_emergency_stop_is_marked_before_its_order_is_answered(tmp_path):
    latch = file_latch(tmp_path)

    async def scenario(bench):
        assert bench.order(Order.ESTOP).reason is Reason.OK
        assert (latch.stored(), latch.engaged()) == (False, True)

    on_bench(scenario, latch)


def test_an_emergency_stop_after_the_last_tick_is_marked_at_once_and_stored_when_the_gate_is_closed(tmp_path):
    latch = file_latch(tmp_path)

    async def main(clock):
        bench = Bench(clock, latch, offload=inline)
        serving = asyncio.create_task(bench.service.run(bench.ready))
        await clock.sleep(0.1)
        serving.cancel()
        await asyncio.wait([serving])
        assert not latch.engaged()
        assert bench.order(Order.ESTOP).reason is Reason.OK
        assert (latch.stored(), latch.engaged()) == (False, True)
        await bench.service.close()

    run_virtual(main)
    assert latch.stored()
    assert list((tmp_path / "run").iterdir()) == []


KILLED = """
import asyncio, os, sys, threading
from pathlib import Path
from monstertruck_runtime.clock import WallClock
from monstertruck_schemas.req import Order
from monstertruckd.gate.latch import EstopLatch
from tests.unit.gate.bench import Bench, Outbox

def fsync(file, wait=threading.Event().wait):
    wait()  # a disk that never comes to an end

class Reported(Outbox):
    def put(self, message):
        super().put(message)
        if sys.argv[2] in (message.mode, "start"):
            print(message.mode, message.latched, flush=True)
            os.kill(os.getpid(), 9)

async def main():
    folder = Path(sys.argv[1])
    latch = EstopLatch(folder / "state" / "estop", folder / "run")
    latch.prepare()
    os.fsync = fsync
    bench = Bench(WallClock(), latch, Reported())
    async with bench.running():
        bench.order(Order.ESTOP)
        await asyncio.sleep(60)

asyncio.run(main())
"""


@pytest.mark.parametrize(
    ("when", "reported", "engaged"), [("estopped", "estopped False", True), ("start", "disarmed False", False)]
)
def test_killed_before_the_disk_has_the_latch_it_starts_as_it_was_reported(tmp_path, when, reported, engaged):
    (tmp_path / "run").mkdir()
    run = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path), when], capture_output=True, text=True, timeout=30, check=False
    )
    assert (run.returncode, run.stdout.strip()) == (-signal.SIGKILL, reported), run.stderr
    latch = file_latch(tmp_path)
    assert not latch.stored()
    assert latch.engaged() is engaged

    async def restarted(bench):
        assert bench.out.state.last.mode is (GateMode.ESTOPPED if engaged else GateMode.DISARMED)
        bench.order(Order.RESET)

    on_bench(restarted, latch)
    assert not file_latch(tmp_path).engaged(), "a reset clears the mark as well"


def test_the_state_says_whether_the_disk_has_the_latch():
    latch = SlowLatch()

    async def main():
        bench = Bench(WallClock(), latch)
        async with bench.running():
            bench.order(Order.ESTOP)
            while bench.out.state.last.mode is not GateMode.ESTOPPED:
                await asyncio.sleep(0.005)
            assert not bench.out.state.last.latched
            assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP
            latch.release.set()
            while not bench.out.state.last.latched:
                await asyncio.sleep(0.005)
        assert latch.marks == [False, True, False], "the mark is cleared once the disk has the latch"

    asyncio.run(main())


def test_a_stop_while_the_one_before_is_being_removed_keeps_its_mark():
    latch = SlowLatch()
    latch.release.set()

    async def main():
        bench = Bench(WallClock(), latch)
        async with bench.running():
            bench.order(Order.ESTOP)
            while not bench.service._latched:
                await asyncio.sleep(0.005)
            latch.release.clear()
            bench.order(Order.RESET)
            while bench.service._latched is not None:
                await asyncio.sleep(0.005)
            bench.order(Order.ESTOP)
            await asyncio.sleep(0.05)
            assert latch.marks[-1]
            latch.release.set()
            while not bench.service._latched:
                await asyncio.sleep(0.005)
        assert latch.engaged()

    asyncio.run(main())


def test_a_mark_that_cannot_be_written_is_an_event_each_second_and_the_stop_goes_on():
    class Full(MemoryLatch):
        full = False
        marks: ClassVar = []

        def mark(self, engaged):
            if self.full:
                raise OSError(28, "no space left")
            self.marks.append(engaged)

        def store(self, engaged):
            raise OSError(28, "no space left")

    latch = Full()

    def marks_failed(bench):
        return len([text for reason, _, text, _ in bench.events if reason is Reason.DISK_FULL])

    async def scenario(bench):
        latch.full = True
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.05)
        assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP
        assert marks_failed(bench) == 2, "one for the mark, one for the disk"
        await bench.clock.sleep(0.9)
        assert marks_failed(bench) == 2
        await bench.clock.sleep(1.0)
        assert marks_failed(bench) in (4, 5)
        latch.full = False
        await bench.clock.sleep(1.2)
        assert latch.marks[-1] is True

    on_bench(scenario, latch)


def test_an_emergency_stop_does_not_wait_for_the_tick():
    async def scenario(bench):
        commands = bench.out.drives[0].messages
        await bench.clock.sleep(0.005)
        before = len(commands)
        bench.order(Order.ESTOP)
        assert [command.action for command in list(commands)[before:]] == [DriveAction.QUICK_STOP]
        assert bench.out.state.last.mode is GateMode.ESTOPPED
        bench.order(Order.ESTOP)
        assert len(commands) == before + 1, "further ones change nothing"

    on_bench(scenario)


@pytest.mark.parametrize("what", ["draft", "mark"])
def test_links_in_the_place_of_latch_and_mark_are_not_followed(tmp_path, what):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    latch = file_latch(tmp_path)
    (mark,) = (tmp_path / "run").iterdir()
    latch.close()
    if what == "mark":
        mark.symlink_to(victim)
        with pytest.raises(OSError, match="symbolic"):
            latch.prepare()
    else:
        latch.prepare()
        (tmp_path / "state" / "estop").symlink_to(victim)
        latch.store(True)
        assert latch.stored()
        assert not (tmp_path / "state" / "estop").is_symlink()
    assert victim.read_text() == "precious"


def test_a_damaged_mark_counts_as_a_stop_and_a_strangers_is_refused(tmp_path):
    latch = file_latch(tmp_path)
    (mark,) = (tmp_path / "run").iterdir()
    latch.close()
    mark.write_text("??")
    assert file_latch(tmp_path).engaged()
    mark.unlink()
    other = tmp_path / "other"
    other.write_text("0")
    mark.hardlink_to(other)
    with pytest.raises(PermissionError, match="this user alone"):
        latch.prepare()


def test_marks_are_kept_where_memory_outlasts_the_daemon(tmp_path):
    configured, service = tmp_path / "own", {"RUNTIME_DIRECTORY": "/run/truck:/run/other"}
    assert marks_folder(configured, service, tmp_path) == configured
    assert marks_folder(None, service, tmp_path) == Path("/run/truck")
    assert marks_folder(None, {}, tmp_path) == tmp_path / "dev/shm"
    (tmp_path / "run").mkdir()
    assert marks_folder(None, {}, tmp_path) == tmp_path / "run"
    (user := tmp_path / f"run/user/{os.geteuid()}").mkdir(parents=True)
    assert marks_folder(None, {}, tmp_path) == user


class Unsynced(EstopLatch):
    """A latch whose folder cannot be synced, e.g. for want of a file descriptor, while ``broken``."""

    broken = False
    readable = True

    def stored(self):
        return super().stored() if self.readable else None


@pytest.fixture
def unsynced(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    latch, sync = Unsynced(tmp_path / "state" / "estop", tmp_path / "run"), small_files.sync_folder
    latch.prepare()

    def sync_folder(folder):
        if latch.broken:
            raise OSError(24, "too many open files")
        sync(folder)

    monkeypatch.setattr(small_files, "sync_folder", sync_folder)
    return latch


@pytest.mark.parametrize("readable", [True, False])
def test_a_stop_after_a_reset_whose_folder_could_not_be_synced_is_latched_again(tmp_path, unsynced, readable):
    latch = unsynced

    async def scenario(bench):
        state = bench.out.state
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.1)
        assert (state.last.latched, latch.stored()) == (True, True)
        latch.broken, latch.readable = True, readable
        assert bench.order(Order.RESET).reason is Reason.OK
        await bench.clock.sleep(0.1)
        assert not (tmp_path / "state" / "estop").exists()
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.1)
        assert (state.last.mode, state.last.latched) == (GateMode.ESTOPPED, False)
        assert latch._mark.engaged()
        latch.broken, latch.readable = False, True
        await bench.clock.sleep(2.0)
        assert (state.last.latched, latch.stored(), latch._mark.engaged()) == (True, True, False)

    on_bench(scenario, latch)


def test_a_reset_of_a_stop_whose_folder_could_not_be_synced_removes_the_file(unsynced):
    latch = unsynced

    async def scenario(bench):
        latch.broken = True
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.1)
        assert (bench.out.state.last.latched, latch.stored(), latch._mark.engaged()) == (False, True, True)
        assert bench.order(Order.RESET).reason is Reason.OK
        await bench.clock.sleep(2.0)
        latch.broken = False
        await bench.clock.sleep(2.0)
        assert (bench.out.state.last.latched, latch.engaged()) == (False, False)

    on_bench(scenario, latch)


class BrokenLatch(MemoryLatch):
    def store(self, engaged):
        raise OSError(28, "no space left")


def test_a_latch_that_cannot_be_stored_is_reported_and_tried_again():
    async def scenario(bench):
        bench.order(Order.ESTOP)
        await asyncio.sleep(0.05)
        while not bench.events[1:]:
            await asyncio.sleep(0.02)
        assert bench.out.state.last.mode is GateMode.ESTOPPED
        await asyncio.sleep(1.5)

    bench = on_bench(scenario, BrokenLatch())
    complaints = [text for reason, _, text, _ in bench.events if reason is Reason.DISK_FULL]
    assert len(complaints) >= 2  # retried, and once more at the end
    assert "no space left" in complaints[0]


def test_the_latch_is_stored_even_if_the_service_ends_in_the_same_instant():
    latch = MemoryLatch()

    async def scenario(bench):
        bench.order(Order.ESTOP)
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    on_bench(scenario, latch)
    assert latch.engaged()


class SlowLatch(MemoryLatch):
    """A disk that takes its time, in whatever thread."""

    def __init__(self):
        super().__init__()
        self.release = threading.Event()
        self.threads = []
        self.marks = []

    def mark(self, engaged):
        self.marks.append(engaged)

    def store(self, engaged):
        self.threads.append(threading.current_thread())
        assert self.release.wait(10)
        super().store(engaged)


def test_a_slow_disk_holds_up_the_end_of_the_service_but_neither_the_loop_nor_the_stop():
    latch = SlowLatch()

    async def main():
        bench = Bench(WallClock(), latch)
        serving = asyncio.create_task(bench.service.run(bench.ready))
        await asyncio.sleep(0.05)
        bench.order(Order.ESTOP)
        while not latch.threads:
            await asyncio.sleep(0.005)
        serving.cancel()
        await asyncio.sleep(0.05)
        assert bench.out.drives[0].last.action is DriveAction.QUICK_STOP
        assert Reason.SHUTDOWN in bench.out.state.last.reasons, "neutral was commanded"
        assert not serving.done()
        assert not latch.engaged()
        latch.release.set()
        with pytest.raises(asyncio.CancelledError):
            await serving
        assert latch.engaged(), "stored before the service ended"
        assert threading.main_thread() not in latch.threads

    asyncio.run(main())


def test_after_quick_changes_of_mind_the_last_one_is_stored():
    latch = MemoryLatch()

    async def scenario(bench):
        for _ in range(3):
            bench.order(Order.ESTOP)
            await bench.clock.sleep(0.021)
            bench.order(Order.RESET)
            await bench.clock.sleep(0.021)

    on_bench(scenario, latch)
    assert not latch.engaged()


def test_the_latch_file_is_synced_and_leaves_no_draft(tmp_path, monkeypatch):
    synced = []
    fsync = os.fsync

    def note(file):
        synced.append(str(Path(f"/proc/self/fd/{file}").readlink()))
        fsync(file)

    monkeypatch.setattr(os, "fsync", note)
    (tmp_path / "run").mkdir()
    folder = tmp_path / "a"
    latch = EstopLatch(folder / "estop", tmp_path / "run")
    assert not latch.engaged()
    latch.store(False)  # nothing there yet
    assert synced == []
    latch.store(True)
    assert latch.engaged()
    made, draft, name = synced
    assert (made, name) == (str(tmp_path), str(folder)), "first the folder and the contents, then the name"
    assert draft.startswith(f"{folder}/estop.")
    assert [path.name for path in folder.iterdir()] == ["estop"]
    synced.clear()
    latch.store(False)
    assert synced == [str(folder)]
    assert not latch.engaged()
    (folder / "estop").touch()
    assert latch.engaged()  # an empty file stops, too


def test_an_unreadable_latch_counts_as_engaged(tmp_path):
    (tmp_path / "file").touch()
    assert EstopLatch(tmp_path / "file" / "estop", tmp_path).engaged()  # not a directory


def test_meter_forgets_percentiles_but_not_the_maximum():
    meter = TickMeter(depth=4)
    assert meter.lateness().ticks == 0
    for lateness in (9.0, 1.0, 2.0, 3.0, 4.0):
        meter.record(lateness)
    found = meter.lateness()
    assert (found.ticks, found.p50, found.p99, found.max) == (5, 2.0, 4.0, 9.0)


def test_a_stop_is_published_with_its_black_box_and_again_when_more_is_known():
    async def scenario(bench):
        bench.order(Order.ARM)
        await bench.clock.sleep(0.05)
        assert bench.ask(bench.service.request, Role.GAMEPAD) is Reason.OK
        await bench.clock.sleep(0.1)
        bench.order(Order.ESTOP)
        await bench.clock.sleep(0.05)
        stop = bench.out.stops.last
        assert (stop.number, stop.reason, stop.mode, stop.holder) == (1, "estop_requested", "estopped", "gamepad")
        assert stop.text == "stopped: emergency stop by ann"
        assert stop.black_box == "box-1"

    async def lease(bench):
        bench.order(Order.ARM)
        await bench.clock.sleep(0.05)
        assert bench.ask(bench.service.request, Role.GAMEPAD) is Reason.OK
        await bench.clock.sleep(0.4)
        down = {"reason": Reason.LINK_DOWN, "severity": "warning", "source": "link", "text": "wlan0: link is down"}
        bench.service.observe_event(Event.model_validate({**header(bench.clock.now()), **down}, strict=False))
        await bench.clock.sleep(0.05)
        first, second = bench.out.stops.messages
        assert (first.number, second.number, second.seq) == (1, 1, 1)
        assert (first.stamp, first.black_box) == (second.stamp, second.black_box)
        assert second.text.endswith("because wlan0: link is down")

    on_bench(scenario)
    bench = on_bench(lease)
    assert bench.boxes == [Reason.LEASE_EXPIRED], "asked for once"
