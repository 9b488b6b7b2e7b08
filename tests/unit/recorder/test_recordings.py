"""Calls for recordings: what is listed, how fast it leaves, and what is refused."""

import base64
import fcntl
import os
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import BusyError, InputError, NotFoundError
from monstertruck_runtime.threads import inline
from monstertruckd.bus.rpc import Rpc
from monstertruckd.recorder.recordings import TURN, Recordings
from monstertruckd.recorder.repair import in_use
from monstertruckd.station.recordings import fetch_recording

DOWNLOAD_RATE = 1_000_000.0
DOWNLOAD_CHUNK = 65_536


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "logs/blackbox").mkdir(parents=True)
    for name, size in (("run-000001-000.mcap", 300_000), ("run-000002-000.mcap", 10), ("notes.txt", 3)):
        (tmp_path / "logs" / name).write_bytes(os.urandom(size))
    (tmp_path / "logs/blackbox/blackbox-000001-estopped.mcap").write_bytes(b"box")
    (tmp_path / "secret.mcap").write_bytes(b"secret")
    (tmp_path / "logs/link.mcap").symlink_to(tmp_path / "secret.mcap")
    return tmp_path / "logs"


def asked(folder: Path, scenario):
    """What the scenario returns, given ``call`` and the clock; and the events."""
    events = []

    async def main(clock):
        rpc = Rpc(clock)
        folders = {"run": folder, "blackbox": folder / "blackbox"}

        def note(reason, severity, source, text="", **values):
            events.append(text)

        Recordings(folders, lambda: folder / "run-000002-000.mcap", clock, note, inline).register(rpc)
        return await scenario(lambda what, **payload: rpc.call(what, {"source": "ann", **payload}), clock)

    return run_virtual(main), events


def test_runs_and_black_boxes_are_listed_and_nothing_else(folder: Path):
    async def scenario(call, _):
        return (await call("recordings"))["recordings"]

    rows = {row["name"]: row for row in asked(folder, scenario)[0]}
    assert {name: (row["kind"], row["bytes"], row["open"]) for name, row in rows.items()} == {
        "run-000001-000.mcap": ("run", 300_000, False),
        "run-000002-000.mcap": ("run", 10, True),
        "blackbox-000001-estopped.mcap": ("blackbox", 3, False),
    }


def test_a_download_comes_in_chunks_at_a_limited_rate_and_goes_on_where_it_was_broken_off(folder: Path):
    async def scenario(call, clock):
        began, data = clock.now(), b""
        while True:
            answer = await call("recording_read", name="run-000001-000.mcap", offset=len(data))
            part = base64.b64decode(answer["data"])
            assert len(part) <= DOWNLOAD_CHUNK
            data += part
            if len(data) == answer["bytes"]:
                return data, (clock.now() - began) / SECOND

    (data, seconds), _ = asked(folder, scenario)
    assert data == (folder / "run-000001-000.mcap").read_bytes()
    assert seconds > (len(data) - DOWNLOAD_CHUNK) / DOWNLOAD_RATE * 0.99


def test_one_source_downloads_at_a_time(folder: Path):
    async def scenario(call, clock):
        await call("recording_read", name="run-000001-000.mcap")
        with pytest.raises(BusyError, match="ann is downloading"):
            await call("recording_read", name="run-000001-000.mcap", source="bob")
        await clock.sleep(TURN + 0.1)
        await call("recording_read", name="run-000001-000.mcap", source="bob")
        await clock.sleep(TURN + 0.1)
        await call("recording_read", name="run-000001-000.mcap", source="eve", offset=290_000)
        await call("recording_read", name="run-000002-000.mcap")  # eve's download is complete

    asked(folder, scenario)


@pytest.mark.parametrize(
    "name", ["../secret.mcap", "link.mcap", "notes.txt", "/etc/passwd", "blackbox/blackbox-000001-estopped.mcap", None]
)
def test_what_is_not_listed_is_neither_read_nor_deleted(folder: Path, name):
    async def scenario(call, _):
        for what in ("recording_read", "recording_delete"):
            with pytest.raises(NotFoundError):
                await call(what, name=name)

    asked(folder, scenario)
    assert (folder.parent / "secret.mcap").exists()


def test_a_recording_is_deleted_with_an_event_and_the_one_being_written_is_not(folder: Path):
    async def scenario(call, _):
        with pytest.raises(BusyError, match="is writing it"):
            await call("recording_delete", name="run-000002-000.mcap")
        with pytest.raises(InputError):
            await call("recording_read", name="run-000002-000.mcap", offset=-1)
        await call("recording_delete", name="run-000001-000.mcap")

    _, events = asked(folder, scenario)
    assert events == ["run-000001-000.mcap (0.3 MB) deleted by ann"]
    assert not (folder / "run-000001-000.mcap").exists()


def test_what_another_daemon_writes_is_open_and_stays(folder: Path):
    async def scenario(call, _):
        with (
            (folder / "run-000001-000.mcap").open("rb") as other,
            (folder / "run-000002-000.mcap").open("rb") as reader,
        ):
            fcntl.flock(other, fcntl.LOCK_EX)
            fcntl.flock(reader, fcntl.LOCK_SH)
            with pytest.raises(BusyError, match="is writing it"):
                await call("recording_delete", name="run-000001-000.mcap")
            assert in_use(folder / "run-000001-000.mcap")
            assert not in_use(folder / "run-000002-000.mcap")
            return {row["name"]: row["open"] for row in (await call("recordings"))["recordings"]}

    rows, _ = asked(folder, scenario)
    assert rows["run-000001-000.mcap"]
    assert not rows["blackbox-000001-estopped.mcap"]


def test_a_fetch_goes_on_with_the_same_recording_alone(folder: Path, tmp_path: Path):
    name, part = "run-000001-000.mcap", tmp_path / "fetched.mcap"
    whole = (folder / name).read_bytes()

    async def scenario(call, _):
        class Robot:
            async def call(self, what, payload):
                return await call(what, **payload)

        part.write_bytes(whole[:200_000])
        assert (await fetch_recording(Robot(), name, part, lambda _: None)).bytes == len(whole)
        assert part.read_bytes() == whole
        assert (await fetch_recording(Robot(), name, part, lambda _: None)).bytes == len(whole)
        part.write_bytes(os.urandom(100_000))  # of another robot, whose recordings have the same names
        before = part.read_bytes()
        with pytest.raises(InputError, match=r"fetched\.mcap: is not the beginning of run-000001-000\.mcap"):
            await fetch_recording(Robot(), name, part, lambda _: None)
        assert part.read_bytes() == before

    asked(folder, scenario)


def test_what_goes_wrong_with_a_file_is_said_and_no_bug(folder: Path, monkeypatch: pytest.MonkeyPatch):
    def gone(path, *_, **__):
        raise FileNotFoundError(2, "No such file or directory")

    async def scenario(call, _):
        beyond = await call("recording_read", name="run-000001-000.mcap", offset=10**24)
        assert beyond == {"data": "", "bytes": 300_000, "open": False}
        with monkeypatch.context() as patch:
            patch.setattr(Path, "open", gone)
            patch.setattr(Path, "unlink", gone)
            for what in ("recording_read", "recording_delete"):
                with pytest.raises(InputError, match=r"run-000001-000\.mcap: cannot be .*: No such file"):
                    await call(what, name="run-000001-000.mcap")
        real, removed = Path.stat, folder / "run-000001-000.mcap"  # between the listing and the look at it
        monkeypatch.setattr(Path, "is_file", lambda _: True)
        monkeypatch.setattr(Path, "stat", lambda path, **more: gone(path) if path == removed else real(path, **more))
        return {row["name"] for row in (await call("recordings"))["recordings"]}

    left, _ = asked(folder, scenario)
    assert left == {"run-000002-000.mcap", "blackbox-000001-estopped.mcap"}
