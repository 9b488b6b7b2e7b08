"""The report of logs made by hand: what it counts, and what the page holds."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Cause, Event, LogLevel, LogRecord, Measurement, Severity, Stop
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, Grid
from monstertruckd.recorder.log_file import LogEntry, LogFile
from monstertruckd.tools.logs.report import report
from monstertruckd.tools.logs.report.collect import collect
from monstertruckd.tools.logs.report.page import page
from tests.unit.recorder.conftest import scan
from tests.unit.tools.logs.log_kit import Writer, clock, gate, odometry


def tracker(now, seq):
    outcome = Reason.DRIVING if seq else Reason.GOAL_REACHED
    common = {"heading_error": 0.0, "along": 1.0, "length": 9.0, "outcome": outcome}
    return TrackerState(stamp=now, received=now, seq=seq, cross_track=0.03 if seq else 9.0, **common)


def event(now, severity, text):
    return Event(
        stamp=now,
        received=now,
        seq=0,
        reason=Reason.HUB_LOST,
        severity=severity,
        source="hub",
        text=text,
        values={"n": 3},
    )


def stop(now):
    far = Measurement(name="clearance", value=0.12, unit="m", limit=0.2, age=0.03)
    first = Cause(reason=Reason.SCAN_STALE, source="lidar", since=now - SECOND, text="no <scan>", because=1)
    behind = Cause(reason=Reason.HUB_LOST, source="usb", since=now - 2 * SECOND, text="hub gone", measurements=(far,))
    return Stop(
        stamp=now,
        received=now,
        seq=0,
        number=1,
        reason=Reason.SCAN_STALE,
        mode=GateMode.STOPPING,
        quick=True,
        causes=(first, behind),
        black_box="box-1.mcap",
        text="stopped: no scan because of the hub",
    )


def health(now, seq, state):
    row = ServiceHealth(name="lidar", state=state, since=now, restarts=seq, detail="no <answer>" if seq else "")
    return HealthTable(stamp=now, received=now, seq=seq, services=(row,))


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "run-000001-000.mcap"
    writer = Writer(file, config={"robot": "digger", "note": "</script><b>"}, versions={"python": "3.13"})
    for i in range(100):
        now = SECOND + i * SECOND // 10
        writer.put(t.ODOMETRY, odometry(now, i))
        writer.put(t.GATE, gate(now, i, GateMode.DRIVING if 20 <= i < 70 else GateMode.DISARMED))
        writer.put(t.TRACKER, tracker(now, i))
        writer.put(t.SCAN, scan(now, i), skip=3 if i == 50 else 0)
    writer.put(t.CLOCK, clock(now))
    writer.put(t.EVENT, event(now, Severity.ERROR, "hub <1-1> gone"))
    for seq, state in enumerate((ServiceState.READY, ServiceState.BACKOFF, ServiceState.FAILED)):
        writer.put(t.HEALTH, health(now + seq * SECOND, seq, state))
    writer.log.finish()
    return file


class Tags(HTMLParser):
    """Checks that tags close in order; collects attributes that could make a request."""

    VOID = {"meta", "circle", "image", "line", "path", "br"}

    def __init__(self):
        super().__init__()
        self.open, self.links = [], []

    def handle_starttag(self, tag, attributes):
        self.links += [value for name, value in attributes if name in {"src", "href", "xlink:href", "action"}]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_figures_are_those_of_the_log(log):
    seen = []
    figures = report(log, progress=seen.append).figures()
    assert figures["robot"] == "digger"
    assert figures["started"] == "2026-05-01 01:46:41"
    assert figures["duration_s"] == pytest.approx(11.9)
    assert figures["distance_m"] == pytest.approx(9.9)
    assert (figures["top_speed_m_s"], figures["driving_s"]) == (1.0, 5.0)
    assert figures["cross_track_rms_m"] == pytest.approx(0.03)
    assert (figures["lost"], figures["damage"], figures["messages"]) == (3, None, 405)
    assert figures["events"] == {"info": 0, "warning": 0, "error": 1}
    assert seen
    assert json.loads(json.dumps(figures)) == figures
    assert log.with_suffix(".html").exists()


def test_page_is_well_formed_and_asks_nobody_for_anything(log):
    text = report(log).file.read_text()
    tags = Tags()
    tags.feed(text)
    assert tags.open == []
    assert all(link.startswith("data:") for link in tags.links)
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|https?://", text)
    assert "default-src 'none'" in text


def test_page_tells_what_the_journal_warned_of(tmp_path):
    file = tmp_path / "run-000001-000.mcap"
    writer = Writer(file)
    for number in range(500):
        for level in LogLevel:
            header = {"stamp": number * SECOND, "received": number * SECOND, "seq": number}
            text = f"{level} <{number}>"
            writer.put(t.LOG, LogRecord(**header, level=level, name="monstertruckd.host.stall", text=text))
    writer.log.finish()
    shown = report(file).file.read_text()
    assert "warning &lt;0&gt;" in shown
    assert "fatal &lt;0&gt;" in shown
    assert "info &lt;0&gt;" not in shown
    assert "1100 more warnings are in the log" in shown


def test_page_tells_events_states_losses_and_config(log):
    text = report(log).file.read_text()
    assert "hub &lt;1-1&gt; gone" in text
    assert "1 error" in text
    assert "3 messages lost" in text
    assert re.search(r'class="good[^>]*title="driving at 0:02.0, 5.0 s"', text)
    assert re.search(r'class="bad[^>]*title="failed at [^"]*no &lt;answer&gt;"', text)
    assert "python 3.13" in text
    assert "&lt;/script&gt;&lt;b&gt;" in text
    assert "data:image/png;base64," in text
    for title in ("Speed", "Cross-track error", "Yaw", "Rates of the devices"):
        assert f"<b>{title}</b>" in text
    assert "<b>Battery</b>" not in text


def test_page_tells_grades_of_the_calibration_and_what_had_expired(tmp_path):
    file = tmp_path / "run.mcap"
    common = {"date": "2026-01-01", "until": "2026-06-30"}
    rows = [
        common | {"wizard": "drive", "grade": "A", "expired": ""},
        common | {"wizard": "lidar", "grade": "C", "expired": ""},
        common | {"wizard": "compass", "grade": "B", "expired": "after <90> days"},
    ]
    writer = Writer(file, calibration={"file": "0001.json", "wizards": rows})
    writer.put(t.GATE, gate(SECOND, 0))
    writer.log.finish()
    text = report(file).file.read_text()
    assert '<span class="badge good">calibration: drive A, lidar C</span>' in text
    assert '<span class="badge warning">calibration of compass expired: after &lt;90&gt; days</span>' in text


def test_stops_are_reported_with_their_chain(tmp_path):
    file = tmp_path / "run.mcap"
    writer = Writer(file)
    writer.put(t.GATE, gate(SECOND, 0))
    writer.put(t.STOP, stop(5 * SECOND))
    writer.log.finish()
    text = report(file).file.read_text()
    assert "stopped: no scan because of the hub" in text
    assert "quick stop, 0.00 m to go, box-1.mcap" in text
    assert "lidar: no &lt;scan&gt; <code>scan_stale since 0:03.00 because of 2</code>" in text
    assert "clearance 0.12 (limit 0.2) m" in text


def test_pictures_left_out_of_a_black_box_are_no_loss(tmp_path):
    file = tmp_path / "box.mcap"
    writer = Writer(file, {"robot": "digger", "stopped_at_ns": "5", "lost": "2"})
    writer.put(t.GATE, gate(SECOND, 0))
    writer.put(t.GATE, gate(2 * SECOND, 1), skip=50)
    writer.log.finish()
    done = report(file)
    assert (done.figures()["lost"], done.figures()["robot"]) == (2, "digger")
    text = done.file.read_text()
    assert "Black box" in text
    assert "left out" in text
    assert "alarm" not in re.search(r"<h2>Messages.*?</table>", text, re.DOTALL)[0]


def test_cursor_data_belongs_to_the_plots(log):
    text = report(log).file.read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', text)[1])
    captions = re.findall(r'<figure class="plot".*?</figcaption>', text, re.DOTALL)
    assert [len(lines) for lines in data["plots"]] == [caption.count("<output>") for caption in captions]
    times, values = data["plots"][0][0]
    assert len(times) == len(values) == 100
    assert (times[-1], set(values), data["milliseconds"]) == (9900, {1.0}, 11900)
    assert data["way"][1][:3] == [0.0, 0.1, 0.2]


def test_truncated_log_is_reported_as_far_as_it_goes(log):
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.7)])
    done = report(log)
    assert 0 < done.run.messages < 405
    assert "has no end: an unknown number lost (from " in done.file.read_text()


def test_log_with_next_to_nothing_still_has_a_page(tmp_path):
    file = tmp_path / "small.mcap"
    writer = Writer(file)
    writer.put(t.GATE, gate(SECOND, 0))
    writer.log.finish()
    text = report(file).file.read_text()
    assert "No poses and no scans" in text
    assert "unknown robot" in text
    assert "date unknown" in text


def test_undecodable_messages_are_counted_and_passed_over(tmp_path):
    file = tmp_path / "odd.mcap"
    log = LogFile(file, "none", 1000, {}, {}, 0)
    log.add(LogEntry(t.COMPASS, 0, 0, 0, b"not json"))
    log.add(LogEntry(t.GATE, SECOND, SECOND, 0, wire.encode(t.GATE, gate(SECOND, 0))))
    log.finish()
    run = collect(file)
    assert run.traffic["sensor/compass"].undecodable == 1
    assert "1 messages could not be decoded" in page(run)


def test_grid_of_the_log_is_the_map(tmp_path):
    file = tmp_path / "grid.mcap"
    writer = Writer(file)
    cells = np.full((40, 60), -1, np.int8)
    cells[10:30, 20:50] = 0
    cells[10, 20:50] = 100
    origin = Pose2D(x=1.0, y=2.0, yaw=0.0)
    message = Grid(
        stamp=1, received=1, seq=0, frame="map", resolution=0.1, width=60, height=40, origin=origin, cells=cells.ravel()
    )
    writer.put(t.MAP, message)
    writer.log.finish()
    picture = collect(file).map.picture()
    area = picture.area
    assert (area.x0, area.y0, area.x1, area.y1) == pytest.approx((3.0, 3.0, 6.0, 5.0))


@pytest.mark.parametrize(
    ("content", "error", "text"), [(None, NotFoundError, "no such log"), (b"", InputError, "no mess")]
)
def test_errors_name_the_log(tmp_path, content, error, text):
    file = tmp_path / "run.mcap"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(error, match=rf"run\.mcap: .*{text}"):
        report(file)


def test_page_that_cannot_be_written_is_named(log, tmp_path):
    (tmp_path / "way").write_text("in it")
    with pytest.raises(InputError, match="cannot be written"):
        report(log, tmp_path / "way" / "page.html")
