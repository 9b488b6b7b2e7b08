"""The recorded drive comes out of the emulated sensor exactly, once, in its own time."""

import asyncio
import gzip
import hashlib
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.hokuyo_urg.recording import RecordedHokuyoEmulator, RecordedRanges
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError
from tests.unit.drivers.hokuyo_urg.rig import STEP_NS, Rig, bench
from tests.unit.drivers.kit import read_until

DATA = Path(__file__).parents[3] / "data" / "urg04lx_exp2.dat.gz"


@pytest.fixture(scope="module")
def recording() -> RecordedRanges:
    return RecordedRanges.load(DATA)


def test_the_file_is_the_published_one(recording: RecordedRanges):
    digest = hashlib.sha256(gzip.decompress(DATA.read_bytes())).hexdigest()
    assert digest.startswith("8fcb61ab87e09c82")
    assert len(recording) == 641
    assert recording.ranges.shape == (641, 683)
    assert recording.times[-1] == 63_162_132_000


@pytest.mark.parametrize(("state", "drift_ppm"), [("scip1", 0.0), ("scip2", 200.0), ("streaming", -200.0)])
def test_all_scans_arrive_exact_and_on_time(recording: RecordedRanges, state: str, drift_ppm: float):
    async def main(clock: VirtualClock) -> tuple[Rig, RecordedHokuyoEmulator]:
        emulator = RecordedHokuyoEmulator(
            clock, recording, state=state, drift_ppm=drift_ppm, jitter=0.006, timer_start=(1 << 24) - 20_000
        )
        async with bench(clock, emulator=emulator) as rig, rig.driving():
            await emulator.finished.wait()
            await asyncio.sleep(0.05)
            return rig, emulator

    rig, emulator = run_virtual(main)
    scans = rig.out.kept
    missed = 641 - len(scans)
    assert missed == 0 or (state == "streaming" and missed < 15)  # those sent before the driver took over
    assert rig.driver.dropped == 0
    assert emulator.began is not None
    for scan, raw, time in zip(scans, recording.ranges[missed:], recording.times[missed:], strict=True):
        valid = raw >= 20
        assert np.array_equal(scan.codes, np.where(valid, 255, raw))
        assert np.array_equal(scan.ranges, np.where(valid, raw / 1000, np.inf))
        truth = emulator.began + time / (1 + drift_ppm * 1e-6) + 43 * STEP_NS
        assert abs(scan.stamp - truth) < 5_000_000
    assert scans[0].start_angle == pytest.approx((43 - 384) * 2 * np.pi / 1024)


def test_a_single_scan_before_the_start_is_the_first(recording: RecordedRanges):
    async def main(clock: VirtualClock) -> None:
        emulator = RecordedHokuyoEmulator(clock, recording, state="scip2")
        async with bench(clock, emulator=emulator) as rig, await rig.port.open() as link:
            link.write(b"BM\n")
            await read_until(link, b"\n\n")
            link.write(b"GS0043072501\n")
            assert (await read_until(link, b"\n\n")).startswith(b"GS0043072501\n00P\n")

    run_virtual(main)


def test_source_gives_the_nearest_revolution(recording: RecordedRanges):
    recording.start(1000)
    assert np.array_equal(recording.scan(1000)[43:726], recording.ranges[0])
    assert np.array_equal(recording.scan(1000 + 63_000_000_000 * 2)[43:726], recording.ranges[-1])
    assert recording.scan(1000)[:43].tolist() == [0] * 43


def _line(time: int, value: str = "100") -> str:
    return " ".join([str(time), *["0"] * 23, *[value] * 683])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains no scans"),
        ("1 2 3\n", ":1: expected 707 numbers, found 3"),
        (_line(5) + "\n" + _line(5), ":2: time 5 does not increase"),
        (_line(5, "x"), ":1: expected whole numbers"),
        (_line(5, "-1"), ":1: expected ranges within"),
        (_line(5, "1000000"), ":1: expected ranges within"),
        ("\xff\n", "expected a recording"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str):
    path = tmp_path / "log.dat"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=message):
        RecordedRanges.load(path)


def test_a_missing_or_damaged_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError):
        RecordedRanges.load(tmp_path / "none.dat.gz")
    (tmp_path / "cut.dat.gz").write_bytes(DATA.read_bytes()[:5000])
    with pytest.raises(InputError):
        RecordedRanges.load(tmp_path / "cut.dat.gz")


def test_plain_text_is_read_too(tmp_path: Path):
    (tmp_path / "log.dat").write_text(_line(5) + "\n" + _line(99) + "\n")
    assert RecordedRanges.load(tmp_path / "log.dat").times.tolist() == [0, 94_000]
