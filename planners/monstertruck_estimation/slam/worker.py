"""SLAM worker for mapping or localisation: ``monstertruck_estimation.slam.worker:SlamWorker``.

A step's input is a ``WorkerInput``, its output a ``WorkerOutput``; the first input carries the configuration.
"""

import math
from dataclasses import replace

import numpy as np

from monstertruck_estimation.slam import storage
from monstertruck_estimation.slam.budget import finished
from monstertruck_estimation.slam.closure import contradiction, describe, in_view, opposed
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.localisation import LocalisationEstimator
from monstertruck_estimation.slam.map_evidence import EvidenceGrid
from monstertruck_estimation.slam.mapping import Estimator, MappingEstimator, MappingEvent
from monstertruck_estimation.slam.movers import View, moved
from monstertruck_estimation.slam.registration import Cloud, fitting
from monstertruck_estimation.slam.scan_matcher import ScanMatcher
from monstertruck_estimation.slam.scans import prepare_input, scans_in_a_room
from monstertruck_estimation.slam.worker_io import ScanInput, ScanLeftOut, Start, WorkerInput, WorkerOutput
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.memory import give_back
from monstertruck_schemas.health import OdometryUse


class SlamWorker:
    """Worker step that holds the map; its construction compiles all numba functions."""

    def __init__(self) -> None:
        self._estimator: Estimator | None = None
        self._longest = np.inf
        self._first: ScanInput | None = None
        self._newest: int | None = None
        self._run = ""
        _warm_up()

    def step(self, inputs: WorkerInput) -> WorkerOutput:
        """Execute one step.

        Raises:
            InputError: the first input has no ``start``.
        """
        try:
            remarks = () if inputs.start is None else self._begin(inputs.start)
        except InputError as problem:
            return WorkerOutput(unreadable=str(problem))
        estimator = self._estimator
        if estimator is None:
            raise InputError("estimation: expected a start message first")
        made, left_out, refused = None, None, None
        if inputs.scan is not None:
            left_out, refused = self._refusal(inputs.scan)
            if left_out is None:
                wrong = estimator.odometry is OdometryUse.CONTRADICTED
                swept = replace(inputs.scan, twist=estimator.twist) if wrong else inputs.scan
                scan = prepare_input(swept, self._longest, estimator.twist)
                if len(scan) < 3:  # minimum number of points of a scan
                    left_out, refused = (
                        ScanLeftOut.EMPTY,
                        f"only {len(scan)} of {len(inputs.scan.ranges)} beams have a return",
                    )
                else:
                    made = estimator.step(scan, inputs.scan)
                    if inputs.other is not None and isinstance(estimator, MappingEstimator):
                        estimator.draw(prepare_input(inputs.other, self._longest), inputs.other)
                    if made is not None and MappingEvent.PRUNED in made.events:
                        give_back()
        joint = estimator.finish() if inputs.finish else None
        tiles, redrawn = estimator.changes() if inputs.tiles else ([], False)
        whole = estimator.patch() if inputs.whole or redrawn else None
        saved, error = self._save(inputs, estimator)
        trajectory, on_map = (estimator.trajectory(), estimator.on_map()) if inputs.trajectory else (None, None)
        counts = dict(estimator.counts)
        bases = estimator.poses_at(np.array(inputs.instants, np.int64)) if inputs.instants else None
        return WorkerOutput(
            made,
            refused,
            left_out,
            tuple(tiles),
            whole,
            counts,
            saved,
            error,
            trajectory,
            on_map,
            bases,
            joint,
            remarks,
        )

    def _begin(self, start: Start) -> tuple[str, ...]:
        """Build the estimator; return remarks on the saved map that it loads."""
        config = start.config
        settings = config.mapper
        self._run = start.run
        self._longest = settings.longest
        if config.mode == "localisation":
            assert config.map is not None
            saved = storage.load(config.map)
            self._estimator = LocalisationEstimator(saved, settings)
            return saved.grid.remarks
        self._estimator = MappingEstimator(settings, config.grid, matcher_of(config.front), start.pose, start.body)
        return ()

    def _refusal(self, scan: ScanInput) -> tuple[ScanLeftOut, str] | tuple[None, None]:
        """Return the reason why a scan cannot be used, without and with figures; None if it can be used."""
        if self._first is None:
            self._first = scan
        elif not _same_field(scan, self._first):
            text = f"{_field_text(scan)}, expected {_field_text(self._first)}"
            return ScanLeftOut.GEOMETRY, f"{ScanLeftOut.GEOMETRY}: {text}"
        if self._newest is not None and scan.stamp <= self._newest:
            return ScanLeftOut.ORDER, f"{ScanLeftOut.ORDER} ({(scan.stamp - self._newest) / 1e9:+.3f} s)"
        self._newest = scan.stamp
        return None, None

    def _save(self, inputs: WorkerInput, estimator: Estimator) -> tuple[str | None, str | None]:
        if inputs.save is None:
            return None, None
        try:
            storage.save(inputs.save, estimator.patch(), estimator.graph(), self._run)
        except (OSError, InputError) as error:
            return None, str(error)
        return str(inputs.save), None


def _same_field(scan: ScanInput, other: ScanInput) -> bool:
    """Whether two scans of one mount cover the same directions: whole circles, or ends within a beam of each other.

    Their numbers of beams may differ. A head that turns endlessly may begin its revolution at any beam.
    """
    if scan.mount != other.mount:
        return False
    if _is_whole_circle(scan) and _is_whole_circle(other):
        return True
    width = max(abs(scan.angle_increment), abs(other.angle_increment))
    return all(abs(one - two) <= width for one, two in zip(_ends(scan), _ends(other), strict=True))


def _is_whole_circle(scan: ScanInput) -> bool:
    """Whether no beam fits between the last and the first one."""
    return (len(scan.ranges) + 1) * abs(scan.angle_increment) > math.tau


def _ends(scan: ScanInput) -> tuple[float, float]:
    """Return the bearings of the first and of the last beam (rad)."""
    return scan.start_angle, scan.start_angle + scan.angle_increment * (len(scan.ranges) - 1)


def _field_text(scan: ScanInput) -> str:
    first, last = _ends(scan)
    return f"{len(scan.ranges)} beams from {first:.3f} to {last:.3f} rad"


def matcher_of(kind: str) -> ScanMatcher | None:
    """Return the scan matcher of this name; None for the default one."""
    if kind == "planar":
        return None
    from monstertruck_estimation.slam.kiss import KissMatcher  # noqa: PLC0415  # its library is for this kind only

    return KissMatcher()


def _warm_up() -> None:
    """Compile everything before the first scan is due."""
    estimator = MappingEstimator(MapperConfig(), GridConfig())
    drive = scans_in_a_room()
    scans, poses = [prepare_input(inputs, 30.0) for inputs in drive], np.array([inputs.odom for inputs in drive])
    for scan, inputs in zip(scans, drive, strict=True):
        estimator.step(scan, inputs)
    keyframes = estimator.mapper.map
    keyframes.optimise()
    finished(opposed(keyframes, np.array((0,)), np.array((len(keyframes) - 1,))))
    estimator.changes()
    # A few scans of a small room do not cover loop closures and saved maps.
    points = scans[0].points
    describe(points)
    moved(View.of(points), View.of(scans[1].points), np.zeros(3))
    fitting(scans[0], Cloud.of(scans[1]), np.zeros(3))
    contradiction(scans, poses, scans, poses)
    in_view(scans, poses, points)
    EvidenceGrid(storage.trinary(estimator.patch())).judge(poses[0], points, np.zeros(2))
