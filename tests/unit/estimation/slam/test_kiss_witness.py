"""The witness by kiss-icp: silent beside a true estimate, and about jumps; it speaks when the estimate slides away."""

from dataclasses import replace

import numpy as np
import pytest

from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_estimation.slam.kiss import KissWitness
from monstertruck_estimation.slam.worker import SlamWorker
from monstertruck_estimation.slam.worker_io import ScanInput, SlamEstimate, Start, WorkerInput
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import LocalisationStatus
from tests.unit.estimation.slam.kit import LIDAR, ROOM, ranges, rounds, scan

TRUTH = rounds(120, laps=1.0)
GOOD = SlamEstimate(
    stamp=0,
    pose=(0.0, 0.0, 0.0),
    covariance=(0.0,) * 9,
    map_from_odom=None,
    status=LocalisationStatus.MAPPING,
    overlap=1.0,
    residual=0.0,
    degeneracy=1.0,
    direction=0.0,
    verdict="accepted",
)


def reports_of(off, **changed) -> list[float]:
    """What the witness reports of estimates that are ``off(k)`` m beside the truth in x."""
    witness, rng = KissWitness(), np.random.default_rng(2)
    reports = []
    for k, pose in enumerate(TRUTH):
        x, y, yaw = pose.tolist()
        estimate = replace(GOOD, stamp=SECOND + k * SECOND // 10, pose=(x + off(k), y, yaw), **changed)
        distance = witness.compare(scan(ROOM, pose, noise=0.01, rng=rng), estimate)
        reports += [] if distance is None else [distance]
    return reports


def test_a_true_estimate_is_not_doubted():
    assert reports_of(lambda _: 0.0) == []


def test_an_estimate_that_slides_away_is_reported_again_and_again():
    reported = reports_of(lambda k: 0.01 * k)
    assert len(reported) >= 3
    assert reported == pytest.approx([0.2] * len(reported), abs=0.08)


def test_a_loop_closure_and_a_doubtful_estimate_are_not_compared():
    assert reports_of(lambda k: 0.01 * k, events=("closed",)) == []
    assert reports_of(lambda k: 0.01 * k, events=("joined",)) == []
    assert reports_of(lambda k: 0.01 * k, status=LocalisationStatus.DEGENERATE) == []


def test_the_worker_asks_the_witness_only_where_configured():
    config = SlamConfig(witness="kiss")
    worker, rng = SlamWorker(), np.random.default_rng(1)
    worker.step(WorkerInput(start=Start(config, tuple(TRUTH[0].tolist()))))
    for k, pose in enumerate(TRUTH[:60]):
        inputs = ScanInput(
            SECOND + k * SECOND // 10,
            ranges(ROOM, pose, noise=0.01, rng=rng),
            LIDAR.start_angle,
            LIDAR.angle_increment,
            LIDAR.range_min,
            LIDAR.range_max,
            odom=tuple(pose.tolist()),
        )
        estimate = worker.step(WorkerInput(scan=inputs)).estimate
        assert estimate is not None
        assert estimate.disagreement is None
    assert SlamConfig().witness is None
