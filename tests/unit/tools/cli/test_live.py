"""What a terminal shows of a message, and the screen of `drive`."""

from types import SimpleNamespace

import pytest
from rich.console import Console

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_schemas import topics
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.tools.cli.live import _explain_silence, shortened
from monstertruckd.tools.driving.session import Stream, draw
from monstertruckd.tools.driving.teleop import Teleop, TeleopRequest
from monstertruckd.tools.status.screen import ScreenState


def test_long_lists_and_texts_are_cut_and_say_so():
    message = {"name": "scan", "ranges": list(range(682)), "data": "A" * 5000, "pose": {"x": 1.0, "of": [1, 2]}}
    short = shortened(message)
    assert short["ranges"] == [0, 1, 2, 3, 4, 5, 6, 7, "... 682 values"]
    assert short["data"].endswith("A... 5000 characters")
    assert len(short["data"]) < 100
    assert (short["name"], short["pose"]) == ("scan", {"x": 1.0, "of": [1, 2]})


BROKEN = (
    "robot 'truck' is running but does not publish sensor/scan yet; waiting; not ready: lidar (/dev/lidar: unplugged)"
)


@pytest.mark.parametrize(
    ("topic", "alive", "said"),
    [
        (topics.SCAN, True, BROKEN),
        (topics.SCAN, False, "robot 'truck' not found at tcp/x:1; waiting for sensor/scan"),
        (
            topics.STAND_POSE,
            True,
            "robot 'truck' only records stand/pose, if `stand:` is set, and never publishes it; waiting",
        ),
    ],
)
def test_a_topic_that_stays_silent_is_explained(
    topic: topics.Topic, alive: bool, said: str, capsys: pytest.CaptureFixture[str]
):
    async def is_alive() -> bool:
        return alive

    async def get_retained(_: topics.Topic) -> HealthTable:
        lidar = ServiceHealth(name="lidar", state=ServiceState.BACKOFF, since=0, detail="/dev/lidar: unplugged\nmore")
        gate = ServiceHealth(name="gate", state=ServiceState.READY, since=0)
        return HealthTable(stamp=0, received=0, seq=0, services=(gate, lidar))

    client = SimpleNamespace(robot="truck", endpoint="tcp/x:1", alive=is_alive, get_retained=get_retained)
    run_virtual(lambda clock: _explain_silence(client, clock, topic))
    assert capsys.readouterr().err.splitlines() == [said]


def state(mode: GateMode) -> ScreenState:
    screen = ScreenState("truck", heard=0)
    screen.take(GateState(stamp=1, received=1, seq=0, mode=mode, nonce="n", speed_limit=0.2))
    return screen


def shown(screen: ScreenState, teleop: Teleop, stream: Stream, width: int = 80) -> str:
    console = Console(width=width, height=24, record=True)
    console.print(draw(screen, teleop, stream, width), height=24)
    lines = console.export_text().splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= width
    return "\n".join(lines[:6])


@pytest.mark.parametrize(
    ("mode", "hint"),
    [(GateMode.DISARMED, "disarmed: Enter arms"), (GateMode.ESTOPPED, "r resets"), (GateMode.DRIVING, "  ")],
)
def test_drive_says_what_to_press(mode: GateMode, hint: str):
    text = shown(state(mode), Teleop(), Stream())
    assert hint in text
    assert "silent" in text
    assert "no answer" in text
    assert "Enter arm  WASD" in text
    assert "q end" in text, "the help fits a terminal of 80 columns"


def test_drive_shows_what_it_asks_for():
    teleop = Teleop()
    for key in ("5", "a", "a", "z", "w"):
        teleop.press(key, SECOND)
    text = shown(state(GateMode.DRIVING), teleop, Stream(TeleopRequest(0.1, 0.1, 0.0), round_trip=0.0123))
    for words in ("▲ forward", "0.10 m/s", "+5.7°", "round trip 12.3 ms", "5 hybrid", "drift +2.9°"):
        assert words in text
    assert "no robot" in shown(state(GateMode.DRIVING), teleop, Stream(trouble="no robot"))
    assert shown(ScreenState("truck", 0), teleop, Stream(TeleopRequest(-0.1, 0.0, 0.0)), 20)
