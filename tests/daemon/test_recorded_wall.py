"""The real recording through the whole daemon to another process; CI plays its first scans, the benchmark all."""

import gzip
from pathlib import Path

import pytest

from benchmarks.recorded_urg import CONFIG, play
from monstertruck_drivers.hokuyo_urg.recording import RecordedRanges
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.yaml_files import yaml_text

pytestmark = [pytest.mark.wall, pytest.mark.timeout(120)]

RECORDING = Path(__file__).resolve().parents[1] / "data" / "urg04lx_exp2.dat.gz"
SCANS = 40


async def test_every_recorded_scan_reaches_another_process_exactly(tmp_path: Path):
    short = tmp_path / "short.dat.gz"
    with gzip.open(RECORDING, "rt") as whole, gzip.open(short, "wt") as part:
        part.writelines(line for line, _ in zip(whole, range(SCANS), strict=False))
    config = tmp_path / "short.yaml"
    config.write_text(yaml_text({"include": str(CONFIG), "version": 1, "sim": {"recording": str(short)}}))
    result = await play(WallClock(), tmp_path / "run", config, RecordedRanges.load(short))
    assert (result.sent, result.received, result.lost) == (SCANS, SCANS, 0)
    assert result.wrong_values == 0
    assert result.out_of_order == 0
    assert result.worst_stamp_ms < 5.0
