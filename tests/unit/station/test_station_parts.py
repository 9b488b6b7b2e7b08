"""Parts of the station: addresses, frames, outboxes, commands, late heartbeats, and the page's texts."""

import asyncio
import json
import math
import re
import ssl
import struct
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime import stations
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.stations import own_source
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import GateMode, GateState, Grid
from monstertruck_schemas.topics import SOURCE_NAME
from monstertruckd.station import commands, frames
from monstertruckd.station import feed as feed_module
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.commands import GiveOrder, Heartbeat
from monstertruckd.station.feed import SHOWN, MapStore, RobotFeed
from monstertruckd.station.pilot import MOST_ASKED, DelayWatch, Pilot
from monstertruckd.station.server import PAGE, Place
from monstertruckd.station.users import StationUsers, add_user
from monstertruckd.station.viewer import MOST_TILES, Viewer

MEMORY = 200
OLDEST = 1.5

LATEST = 0.2
KEPT_EVENTS = 200


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


@pytest.mark.parametrize(
    "text", ["", "a/b@tcp/h:1", "*@tcp/h:1", "truck@", "truck@192.168.1.7", "truck@tcp/192.168.1.7"]
)
def test_a_wrong_robot_is_refused_with_what_was_expected(text: str):
    with pytest.raises(InputError, match="expected"):
        RobotAddress.parse(text)


def test_what_is_not_finite_is_null_on_the_page():
    """JSON has no word for it, and a damaged log may hold it."""
    assert json.loads(frames.text("pose", pose=[1.0, math.inf, math.nan]))["pose"] == [1.0, None, None]
    assert head_and_payload(frames.binary("scan", b"", tilt=-math.inf))[0]["tilt"] is None


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
    shown = next(row for row in SHOWN if row.topic is topics.SCAN_2)
    assert head_and_payload(shown.encode(scan))[0] == head | {"kind": "scan_2"}


async def test_a_map_is_announced_fetched_and_changed_by_tiles():
    store = MapStore()
    assert await store.packed() is None
    announced = json.loads(store.take(grid()))
    assert announced["version"] == 1
    packed = await store.packed()
    assert packed is not None
    assert await store.packed() is packed, "one compression for all browsers"
    store.change(grid(2, 2, x=0.2))
    place, tile = store.change(grid(2, 2, x=0.2))
    assert place == (0.2, -1.0)
    assert head_and_payload(tile)[0]["version"] == 1, "of the map that it changes"
    for i in range(1, MOST_TILES + 1):
        store.change(grid(2, 2, x=0.2 * i))
    assert len(store.tiles) == MOST_TILES
    store.change(grid(1, 1, x=0.2))
    assert head_and_payload(store.tiles[0.2, -1.0])[0]["width"] == 1, "the newest of each place, however many there are"
    store.take(grid())
    assert store.tiles == {}, "the whole map holds them"


async def test_a_browser_that_does_not_read_gets_the_newest_only_and_bounded_events():
    viewer, most = Viewer(), 256
    for number in range(3 * most):
        viewer.show("scan", str(number))
        viewer.show("camera", b"picture")
        viewer.send(f"event {number}")
        viewer.patch((number % 2, 0.0), str(-number))
    received = [await viewer.next() for _ in range(most + 4)]
    assert received[0] == f"event {2 * most}"
    last = 3 * most - 1
    assert received[-4:] == [str(last), str(1 - last), str(-last), b"picture"], (
        "the newest; pictures of the camera last"
    )
    assert viewer.lost == 2 * most
    waiting = asyncio.create_task(viewer.next())
    await asyncio.sleep(0)
    assert not waiting.done()
    viewer.show("pose", "here")
    assert await waiting == "here"


def test_commands_are_read_and_wrong_ones_refused_by_field():
    order = commands.parse('{"do": "order", "id": 3, "order": "estop"}')
    assert isinstance(order, GiveOrder)
    motion = commands.parse('{"do": "drive", "heard": 1.5, "since": 2, "input": "keys", "speed": 0.1, "front": 0.2}')
    assert isinstance(motion, Heartbeat)
    assert motion.role is Role.KEYBOARD
    for wrong, field in (
        ('{"do": "order", "id": 3, "order": "explode"}', "order"),
        ('{"do": "drive", "heard": 1, "since": 2, "input": "keys", "speed": NaN}', "speed"),
        ('{"do": "fly"}', "message"),
        ('{"do": "drive", "heard": 1, "since": 2, "input": "keys", "role": "estop"}', "role"),
        ("[]", "message"),
        ("{", "message: Invalid JSON"),
        ('{"do": "drive", "heard": 1, "since": 2, "input": "voice"}', r"message\.drive\.input: "),
    ):
        with pytest.raises(InputError, match=field):
            commands.parse(wrong)


def test_a_heartbeat_that_was_held_up_is_known_by_the_ways_of_the_others_and_by_its_own():
    watch = DelayWatch()
    for number in range(20):
        assert watch.late(7.0, 0.05 * number, 7.01 + 0.05 * number + 0.003 * (number % 2)) is None
    assert watch.late(7.0, 1.0, 8.0 + 1.5 * LATEST) == pytest.approx(1.5 * LATEST, abs=0.02)
    # A way that was always long: what the hand did before it says nothing of now.
    for number in range(2 * MEMORY):
        assert watch.late(20.0, 0.05 * number, 20.1 + OLDEST + 0.05 * number) is not None
    # A computer that slept: its clock stood, and what it hears next it counts from.
    assert watch.late(60.0, 0.02, 60.03) is None


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


async def test_a_browser_that_comes_late_gets_everything_however_much_there_is():
    feed, viewer = RobotFeed(RobotAddress("truck", "tcp/127.0.0.1:1"), WallClock()), Viewer()
    feed._facts = frames.text("facts")
    for number in range(KEPT_EVENTS):
        feed._events.append(frames.text("event", number=number))
    feed.map.take(grid())
    for number in range(MOST_TILES):
        feed.map.change(grid(2, 2, x=0.2 * number))
    viewer.send(frames.text("robot", name="truck"))
    feed.attach(viewer)
    received = [await viewer.next() for _ in range(3 + KEPT_EVENTS + MOST_TILES)]
    kinds = [json.loads(frame)["kind"] for frame in received if isinstance(frame, str)]
    assert (kinds[0], kinds.count("event"), kinds.count("facts")) == ("robot", KEPT_EVENTS, 1)
    assert viewer.lost == 0


class RestartedRobot(PublishedRobot):
    """Client of a robot whose daemon is started anew, and which says strange things of itself."""

    def __init__(self):
        super().__init__()
        self.nonce = "first"
        self.asked = 0

    async def get_retained(self, topic):
        self.asked += 1
        return gate_state(self.nonce)

    async def call(self, name, payload=None):
        return {"robot": "truck"}  # no gate: another release


def gate_state(nonce: str = "n") -> GateState:
    return GateState(stamp=1, received=1, seq=0, mode=GateMode.DRIVING, nonce=nonce, speed_limit=0.2)


async def test_a_daemon_that_was_started_anew_is_another_robot_and_strange_facts_end_nothing(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(feed_module, "PING", 0.01)
    robot, feed = RestartedRobot(), RobotFeed(RobotAddress("truck", "tcp/127.0.0.1:1"), WallClock())
    viewer = Viewer()
    following = asyncio.create_task(feed._follow(robot))
    try:
        feed.attach(viewer)
        async with asyncio.timeout(5):
            while "state/gate" not in robot.boxes or robot.asked < 3:
                await asyncio.sleep(0.01)
            box = robot.boxes["state/gate"]
            box.put(gate_state())
            while json.loads(await viewer.next())["kind"] != "gate":
                pass
            robot.nonce = "second"
            while robot.boxes.get("state/gate", box) is box:
                await asyncio.sleep(0.01)
            assert robot.boxes["state/gate"].latest is None, "nothing of the run before is shown on"
            kinds = []
            while "robot" not in kinds:
                kinds.append(json.loads(await viewer.next())["kind"])
            assert "gate" not in kinds[kinds.index("robot") :]
        assert not following.done()
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)


async def test_a_robot_that_cannot_be_followed_ends_no_station(monkeypatch: pytest.MonkeyPatch):
    class Strange:
        def __init__(self, *args, **more):
            pass

        async def __aenter__(self):
            raise ValueError("out of range float values")

        async def __aexit__(self, *error):
            pass

    monkeypatch.setattr(feed_module, "TruckClient", Strange)
    feed = RobotFeed(RobotAddress("truck", "tcp/127.0.0.1:1"), WallClock())
    running = asyncio.create_task(feed.run())
    async with asyncio.timeout(5):
        while "out of range" not in feed._link:
            await asyncio.sleep(0.01)
    assert not running.done()
    running.cancel()


class Orders:
    """Client of a robot that never says how an order ended."""

    def __init__(self):
        self.given: list[Order] = []

    def order(self, order, *, hold=False):
        self.given.append(order)
        return asyncio.Event().wait()

    async def drive(self, *motion, lease, unseen):
        self.given.append(Order.ARM)


async def test_a_stop_goes_by_any_session_and_other_commands_of_one_browser_are_bounded():
    spare, viewer, own = Orders(), Viewer(), Orders()
    pilot = Pilot(RobotAddress("truck", "tcp/127.0.0.1:1"), "page", viewer, WallClock(), lambda: spare)
    for order in ("arm", "estop"):
        pilot.ask(commands.parse(json.dumps({"do": "order", "id": 1, "order": order})))
    assert spare.given == [Order.ESTOP], "the page's own session is not there yet: nothing but a stop takes another one"
    pilot._client = own
    for _ in range(2 * MOST_ASKED):
        pilot.ask(commands.parse('{"do": "order", "id": 2, "order": "arm"}'))
    pilot.ask(commands.parse('{"do": "order", "id": 3, "order": "estop"}'))
    assert own.given.count(Order.ARM) < MOST_ASKED + 1
    assert own.given[-1] is Order.ESTOP
    answers = [json.loads(await viewer.next()) for _ in range(2)]
    assert [answer["reason"] for answer in answers] == ["not_found", "busy"]
    own.given.clear()
    for ready in (False, True):
        pilot._ready = ready
        beat = {"do": "drive", "heard": WallClock().now() / 1e6, "since": 0, "input": "keys", "speed": 0.1}
        pilot.drive(commands.parse(json.dumps(beat)))
        await asyncio.sleep(0)
        assert len(own.given) == ready, "a heartbeat that would have to wait grows old"
    for task in pilot._answers:
        task.cancel()


def test_the_page_is_asked_for_by_the_names_and_the_scheme_that_browsers_use(tmp_path: Path):
    file = tmp_path / "users.yaml"
    add_user(file, "ann", AccessRole.PILOT, "long enough")
    local = Place(port=80)
    assert {"localhost", "localhost:80", "[::1]"} <= local.names
    assert "localhost" not in Place(port=8470).names
    users, tls = StationUsers(file), ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    wide = Place("fd00::7", 443, tls, users, ("Robots.Example",))
    assert {"[fd00::7]", "[fd00::7]:443", "robots.example"} <= wide.names
    assert "https://robots.example" in wide.origins
    assert "http://robots.example:443" not in wide.origins, "anybody on the network can serve a page without TLS"


@pytest.mark.parametrize("owner", [None, "a-station", "o" * 30, "o" * 62])
def test_a_source_keeps_its_owner_and_what_tells_it_apart(owner: str | None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(stations.socket, "gethostname", lambda: "a-laptop-with-a-long-name.of.some.department.example")
    names = [own_source(owner, f"{'u' * 24}-beef.{number}") for number in (1, 2)]
    assert all(SOURCE_NAME.fullmatch(name) for name in names)
    if owner is not None:
        assert {name.partition(":")[0] for name in names} == {owner}
    if owner is None or len(owner) < 60:
        assert names[0] != names[1]
