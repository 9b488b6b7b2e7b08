"""The service around the worker: a map that is asked for is saved, with scans and without."""

import asyncio
import math
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import pytest

from monstertruck_estimation.odometry import _message as odometry_message
from monstertruck_estimation.slam import service as module
from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_estimation.slam.service import SlamService
from monstertruck_estimation.slam.worker_io import SlamEstimate, WorkerInput, WorkerOutput
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_schemas.body import Mount
from monstertruck_schemas.health import LocalisationStatus
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Odometry
from tests.unit.estimation.kit import Truck, drive_feedback


class FakeWorker:
    """Notes what it is asked; a step takes 50 ms."""

    tasks: list[WorkerInput]
    at_once: int
    statuses: ClassVar[list[LocalisationStatus]] = []
    """Status of each scan to come."""
    happened: ClassVar[list[tuple[str, ...]]] = []
    """Events of each scan to come."""
    fault: ClassVar[str | None] = None
    """Fault of the lidar's mount."""

    def __init__(self, name: str, target: str, clock: VirtualClock, **settings: float) -> None:
        FakeWorker.tasks, FakeWorker.at_once = [], 0
        self.pid, self._clock, self._busy = 1, clock, 0

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        return

    async def start(self) -> None:
        return

    async def step(self, task: WorkerInput) -> WorkerOutput:
        self.tasks.append(task)
        self._busy += 1
        FakeWorker.at_once = max(FakeWorker.at_once, self._busy)
        await self._clock.sleep(0.05)
        self._busy -= 1
        saved = None if task.save is None else str(task.save)
        if not self.statuses or task.scan is None:
            return WorkerOutput(saved=saved)
        counts = {"scans": 1, "keys": 1, "closures": 0, "rejected": 0}
        status, pose = self.statuses.pop(0), (0.0, 0.0, 0.0)
        events = self.happened.pop(0) if self.happened else ()
        made = SlamEstimate(
            task.scan.stamp, pose, (0.0,) * 9, None, status, 1.0, 0.0, 0.0, 0.0, "", events, mount_fault=self.fault
        )
        return WorkerOutput(made, saved=saved, counts=counts)


class Nowhere:
    """A publisher that nobody hears."""

    def put(self, message: object) -> None:
        return

    def next_seq(self) -> int:
        return 1


def scan(clock: VirtualClock) -> LaserScan:
    return LaserScan(
        stamp=clock.now(), received=clock.now(), seq=1, frame="lidar", start_angle=-2.0, end_angle=2.0,
        time_increment=0.0, scan_time=0.1, range_min=0.02, range_max=5.6, ranges=np.full(41, 2.0, np.float32),
        codes=np.full(41, 255, np.uint8),
    )  # fmt: skip


def events_of(story, monkeypatch: pytest.MonkeyPatch, folder: Path) -> list[tuple[Reason, str]]:
    """Let a service run through it; returns the events while it ran."""
    monkeypatch.setattr(module, "WorkerActor", FakeWorker)
    events: list[tuple[Reason, str]] = []

    async def main(clock: VirtualClock) -> list[tuple[Reason, str]]:
        scans: Mailbox[LaserScan] = Mailbox(fifo(4))
        service = SlamService(
            SlamConfig(mode="mapping", save=folder), Mount(), clock, scan=scans, odometry=None, angles=None,
            pose=Nowhere(), whole=Nowhere(), tiles=Nowhere(), motion=Nowhere(), health=Nowhere(),
            events=lambda reason, severity, source, text="", **values: events.append((reason, text)),
        )  # fmt: skip
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.1)
        await story(clock, scans, service)
        during = list(events)
        task.cancel()
        await asyncio.wait([task])
        return during

    return run_virtual(main)


def test_a_map_that_is_asked_for_is_saved_though_no_scan_comes(monkeypatch, tmp_path: Path):
    async def story(clock, scans, service):
        scans.put(scan(clock))
        await clock.sleep(1.0)
        assert service.save_soon()
        await clock.sleep(2.0)

    assert events_of(story, monkeypatch, tmp_path) == [(Reason.MAP_SAVED, str(tmp_path))]
    assert [task.scan is None for task in FakeWorker.tasks[:2]] == [False, True]


def test_along_a_corridor_it_does_not_say_with_every_scan_that_a_direction_is_open(monkeypatch, tmp_path: Path):
    fits, open_, lost = LocalisationStatus.MAPPING, LocalisationStatus.DEGENERATE, LocalisationStatus.LOST
    FakeWorker.statuses[:] = [fits, open_, fits, open_, fits, lost, open_, fits]

    async def story(clock, scans, service):
        while FakeWorker.statuses:
            scans.put(scan(clock))
            await clock.sleep(0.2)

    said = [reason for reason, _ in events_of(story, monkeypatch, tmp_path)]
    assert said == [Reason.MATCH_DEGENERATE, Reason.POSE_LOST, Reason.POSE_FOUND]


def test_a_join_that_is_undone_is_a_warning_of_its_own(monkeypatch, tmp_path: Path):
    fits, lost = LocalisationStatus.MAPPING, LocalisationStatus.LOST
    FakeWorker.statuses[:], FakeWorker.happened[:] = [fits, fits, lost], [(), ("key", "joined"), ("key", "parted")]

    async def story(clock, scans, service):
        while FakeWorker.statuses:
            scans.put(scan(clock))
            await clock.sleep(0.2)

    said = events_of(story, monkeypatch, tmp_path)
    assert [reason for reason, _ in said] == [Reason.LOOP_CLOSED, Reason.JOIN_UNDONE, Reason.POSE_LOST]
    assert said[1][1] == "later scans contradict it"


def test_a_fault_of_the_lidars_mount_is_reported_once(monkeypatch, tmp_path: Path):
    FakeWorker.statuses[:] = [LocalisationStatus.MAPPING] * 3
    monkeypatch.setattr(FakeWorker, "fault", "the lidar is turned")

    async def story(clock, scans, service):
        while FakeWorker.statuses:
            scans.put(scan(clock))
            await clock.sleep(0.2)

    assert events_of(story, monkeypatch, tmp_path) == [(Reason.LIDAR_TURNED, "the lidar is turned")]


def test_another_floor_is_a_warning(monkeypatch, tmp_path: Path):
    FakeWorker.statuses[:], FakeWorker.happened[:] = [LocalisationStatus.MAPPING], [("key", "changed")]

    async def story(clock, scans, service):
        scans.put(scan(clock))
        await clock.sleep(0.2)

    assert [reason for reason, _ in events_of(story, monkeypatch, tmp_path)] == [Reason.MAP_CHANGED]


def test_with_scans_it_is_saved_once_with_the_next_one(monkeypatch, tmp_path: Path):
    async def story(clock, scans, service):
        for k in range(40):
            scans.put(scan(clock))
            await clock.sleep(0.06)
            if k == 5:
                service.save_soon()

    assert events_of(story, monkeypatch, tmp_path) == [(Reason.MAP_SAVED, str(tmp_path))]
    assert FakeWorker.at_once == 1


def test_before_the_first_scan_there_is_nothing_to_save(monkeypatch, tmp_path: Path):
    async def story(clock, scans, service):
        service.save_soon()
        await clock.sleep(3.0)

    assert events_of(story, monkeypatch, tmp_path) == []
    assert FakeWorker.tasks == []


def test_a_pose_that_no_scan_confirms_is_as_uncertain_as_odometry_makes_it(monkeypatch, tmp_path: Path):
    monkeypatch.setattr(module, "WorkerActor", FakeWorker)
    turn, poses = 1.1, []

    class Poses(Nowhere):
        def put(self, message: Odometry) -> None:
            poses.append(message)

    async def main(clock: VirtualClock) -> None:
        scans, odometry = Mailbox(fifo(4)), Mailbox(fifo(64))
        service = SlamService(
            SlamConfig(mode="mapping"), Mount(), clock, scan=scans, odometry=odometry, angles=None, pose=Poses(),
            whole=Nowhere(), tiles=Nowhere(), motion=Nowhere(), health=Nowhere(), events=lambda *_, **__: None,
        )  # fmt: skip
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.1)
        truck = Truck()
        truck.now = clock.now()
        truck.drive(0.2, 0.0, 0.0, 5.0)  # what it knew badly before the map was found does not count
        for k in range(600):
            truck.drive(0.2, 0.0, 0.0, 0.02)
            truck.reckoning.observe_drive(drive_feedback(truck.now, truck.motor))
            found = truck.reckoning.estimate(truck.now)
            await clock.sleep_until(truck.now)
            odometry.put(odometry_message(found, truck.now, k))
            await clock.sleep(0.0)
            if k == 20:
                status = LocalisationStatus.MAPPING
                estimate = SlamEstimate(
                    truck.now, (0.0, 0.0, 0.0), tuple((np.eye(3) * 1e-4).ravel()), (0.0, 0.0, turn), status,
                    1.0, 0.0, 0.0, 0.0, "",
                )  # fmt: skip
                counts = dict.fromkeys(("scans", "keys", "closures", "rejected"), 0)
                service._take(WorkerOutput(estimate, counts=counts), scan(clock))
        task.cancel()
        await asyncio.wait([task])

    run_virtual(main)
    soon, late = poses[40], poses[-1]
    assert np.sqrt(np.diag(soon.pose_covariance.reshape(3, 3))) == pytest.approx([0.01] * 3)
    assert ("lidar" in soon.sources, "lidar" in late.sources) == (True, False)
    # 11.6 m further, along the truck's axis in map and across it, as dead reckoning alone says it.
    along, across = (np.array((math.cos(a), math.sin(a), 0.0)) for a in (turn, turn + math.pi / 2))
    way = 0.2 * 0.02 * 579
    swung = 0.05**2 * way**3 / 3 + 0.01**2 * way + (0.01 * way) ** 2 + 0.01**2
    cov = late.pose_covariance.reshape(3, 3)
    assert along @ cov @ along == pytest.approx(0.02**2 * way + 0.01**2, rel=0.05)
    assert across @ cov @ across == pytest.approx(swung, rel=0.05)
    assert cov[2, 2] == pytest.approx(0.05**2 * way + 0.01**2, rel=0.05)
