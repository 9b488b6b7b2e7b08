"""Parts of the station: addresses, frames, outboxes, commands, late heartbeats, and the page's texts."""

import asyncio
import json
import re
import struct

import numpy as np
import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.req import Role
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import GateMode, GateState, Grid
from monstertruckd.station import commands, frames
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.commands import GiveOrder, Heartbeat
from monstertruckd.station.feed import MapStore, RobotFeed
from monstertruckd.station.pilot import LATEST, DelayWatch
from monstertruckd.station.server import PAGE
from monstertruckd.station.viewer import MOST_WAITING, Viewer


def grid(width: int = 4, height: int = 3, x: float = 0.0) -> Grid:
    cells = np.arange(width * height, dtype=np.int8)
    origin = Pose2D(x=x, y=-1.0, yaw=0.0)
    return Grid(stamp=1, received=1, seq=0, resolution=0.1, width=width, height=height, origin=origin, cells=cells)


def head_and_payload(frame: bytes) -> tuple[dict[str, object], bytes]:
    (length,) = struct.unpack_from("<I", frame)
    return json.loads(frame[4 : 4 + length]), frame[4 + length :]


def test_a_robot_is_named_with_or_without_its_endpoint():
    assert RobotAddress.parse("a-1@tcp/10.0.0.1:7447") == RobotAddress("a-1", "tcp/10.0.0.1:7447")
    assert RobotAddress.parse("truck").endpoint.endswith(DEFAULT_ENDPOINT.rpartition(":")[2]) or "sock" in (
        RobotAddress.parse("truck").endpoint
    )


@pytest.mark.parametrize("text", ["", "a/b@tcp/h:1", "*@tcp/h:1", "truck@", "truck@192.168.1.7"])
def test_a_wrong_robot_is_refused_with_what_was_expected(text: str):
    with pytest.raises(InputError, match="expected"):
        RobotAddress.parse(text)


def test_a_scan_travels_as_millimetres_and_beams_without_a_range_as_zero():
    scan = LaserScan(
        stamp=5,
        received=6,
        seq=0,
        frame="lidar",
        start_angle=-1.0,
        end_angle=1.0,
        time_increment=0.001,
        scan_time=0.1,
        range_min=0.02,
        range_max=100.0,
        ranges=np.array([0.5, np.inf, 1.2344, 90.0]),
        codes=np.full(4, 255, dtype=np.uint8),
    )
    head, payload = head_and_payload(frames.scan(scan))
    assert np.frombuffer(payload, "<u2").tolist() == [500, 0, 1234, 0]
    assert head["kind"] == "scan"
    assert head["start"] == -1.0


async def test_a_map_is_announced_fetched_and_changed_by_tiles():
    store = MapStore()
    assert await store.packed() is None
    announced = json.loads(store.take(grid()))
    assert announced["version"] == 1
    packed = await store.packed()
    assert packed is not None
    assert await store.packed() is packed, "one compression for all browsers"
    store.change(grid(2, 2, x=0.2))
    store.change(grid(2, 2, x=0.2))
    store.change(grid(2, 2, x=0.4))
    assert len(store.tiles) == 2
    store.take(grid())
    assert store.tiles == {}, "the whole map holds them"


async def test_a_browser_that_does_not_read_gets_the_newest_only_and_bounded_events():
    viewer = Viewer()
    for number in range(3 * MOST_WAITING):
        viewer.show("scan", str(number))
        viewer.show("camera", b"picture")
        viewer.send(f"event {number}")
    received = [await viewer.next() for _ in range(MOST_WAITING + 2)]
    assert received[0] == f"event {2 * MOST_WAITING}"
    assert received[-2:] == [str(3 * MOST_WAITING - 1), b"picture"], "the newest; pictures of the camera last"
    assert viewer.lost == 2 * MOST_WAITING
    waiting = asyncio.create_task(viewer.next())
    await asyncio.sleep(0)
    assert not waiting.done()
    viewer.show("pose", "here")
    assert await waiting == "here"


def test_commands_are_read_and_wrong_ones_refused_by_field():
    order = commands.parse('{"do": "order", "id": 3, "order": "estop"}')
    assert isinstance(order, GiveOrder)
    motion = commands.parse('{"do": "drive", "at": 1.5, "input": "keys", "speed": 0.1, "front": 0.2}')
    assert isinstance(motion, Heartbeat)
    assert motion.role is Role.KEYBOARD
    for wrong, field in (
        ('{"do": "order", "id": 3, "order": "explode"}', "order"),
        ('{"do": "drive", "at": 1, "input": "keys", "speed": NaN}', "speed"),
        ('{"do": "fly"}', "message"),
        ('{"do": "drive", "at": 1, "input": "keys", "role": "estop"}', "role"),
        ("[]", "message"),
        ("{", "message"),
    ):
        with pytest.raises(InputError, match=field):
            commands.parse(wrong)


def test_a_heartbeat_that_was_held_up_is_known_by_the_times_of_the_others():
    lateness = DelayWatch()
    for number in range(20):
        assert lateness.of(1000.0 + 0.05 * number, 7.0 + 0.05 * number + 0.003 * (number % 2)) < 0.01
    assert lateness.of(1001.0, 8.5) > LATEST


def test_every_text_of_the_page_is_in_the_table_and_none_is_left_over():
    table = json.loads((PAGE / "strings" / "en.json").read_text(encoding="utf-8"))
    sources = "\n".join(file.read_text(encoding="utf-8") for file in PAGE.glob("*.[jh]*"))
    page = (PAGE / "index.html").read_text(encoding="utf-8")
    named = set(re.findall(r'data-(?:s|aria|label)="([^"]+)"', page)) | set(re.findall(r'words\("([^"]+)"', sources))
    assert sorted(named - table.keys()) == []
    stems = set(re.findall(r"words\(`([a-z.]+)\$\{", sources)) | {"order.", "network."}
    unused = [key for key in table if f'"{key}"' not in sources and not key.startswith(tuple(stems))]
    assert unused == []
    texts = re.findall(r">\s*([A-Za-z][^<{]*[a-z])\s*<", page)
    assert texts == ["monstertruckd"], "the title; every other text comes from the table"


class PublishedRobot:
    """Client of a robot whose gate has said something once."""

    def __init__(self):
        self.boxes: dict[str, Mailbox] = {}

    def subscribe(self, topic, delivery):
        self.boxes[topic.name] = Mailbox(delivery, lambda _: self.boxes.pop(topic.name))
        return self.boxes[topic.name]


async def test_a_browser_never_begins_with_what_was_true_when_another_one_left():
    robot, feed = PublishedRobot(), RobotFeed(RobotAddress("truck", "tcp/127.0.0.1:1"), WallClock())
    sampling = asyncio.create_task(feed._sample(robot))
    try:
        first = Viewer()
        feed.attach(first)
        while "state/gate" not in robot.boxes:
            await asyncio.sleep(0.01)
        gate = GateState(stamp=1, received=1, seq=0, mode=GateMode.DRIVING, nonce="n", speed_limit=0.2)
        robot.boxes["state/gate"].put(gate)
        kinds: list[str] = []
        while "gate" not in kinds:
            kinds.append(json.loads(await first.next())["kind"])
        feed.detach(first)
        while robot.boxes:
            await asyncio.sleep(0.01)
        second = Viewer()
        feed.attach(second)
        assert json.loads(await second.next())["kind"] == "link"
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.2):
                await second.next()
    finally:
        sampling.cancel()
        await asyncio.gather(sampling, return_exceptions=True)
