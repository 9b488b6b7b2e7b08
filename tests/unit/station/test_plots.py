"""Numbers of messages over time: what may be plotted, and what browsers get."""

import json
from contextlib import ExitStack, nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.sensor import Battery, BatteryLevel
from monstertruckd.station import commands
from monstertruckd.station.plots import Sampler, Subscriptions, numbers, require_numbers
from monstertruckd.station.viewer import Viewer
from tests.unit.station.test_server import connected, serving

VOLTAGE, X = "sensor/battery:voltage", "state/pose:pose.x"


def battery(seconds: float, voltage: float | None) -> Battery:
    stamp = round(seconds * SECOND)
    return Battery(
        stamp=stamp, received=stamp, seq=1, voltage=voltage, raw_voltage=7.4, cells=2, level=BatteryLevel.NORMAL
    )


def plotting(*names: str) -> Viewer:
    viewer = Viewer()
    viewer.plotted, viewer.plot_set = names, 3
    return viewer


async def received(viewer: Viewer) -> dict[str, Any]:
    frame: dict[str, Any] = json.loads(await viewer.next())
    return frame


def test_every_number_of_a_topic_is_offered_with_its_meaning_also_within_records_and_where_it_may_be_absent():
    assert {VOLTAGE, X, "state/gate:speed_limit", "health/loop:lateness_p99"} <= numbers().keys()
    assert "m/s" in numbers()["state/gate:speed_limit"]
    assert not [name for name in numbers() if name.startswith("req/") or name.endswith((":stamp", ":mode", ":ranges"))]


@pytest.mark.parametrize("name", ["", "state/gate", "state/gate:mode", "state/gate:__class__", "req/drive:speed"])
def test_what_is_no_number_is_refused_by_its_name(name: str):
    with pytest.raises(InputError, match=f"^{name}: expected a numeric field of a topic"):
        require_numbers([VOLTAGE, name])


async def test_a_browser_gets_what_is_new_in_the_order_of_its_choice():
    newest: dict[str, Any] = {}
    sampler, viewer, other = Sampler(newest.get), plotting(X, VOLTAGE), Viewer()
    sampler.sample([viewer, other])
    newest["sensor/battery"] = battery(5.0, 7.41)
    sampler.sample([viewer, other])
    sampler.sample([viewer, other])
    newest["sensor/battery"] = battery(6.0, None)
    sampler.sample([viewer, other])
    assert await received(viewer) == {"kind": "samples", "set": 3, "at": 5.0, "values": [None, 7.41]}
    assert (await received(viewer))["at"] == 6.0, "nothing is sent where nothing is new"
    other.send("end")
    assert await other.next() == "end", "who plots nothing gets nothing"


def test_a_topic_is_subscribed_to_once_and_only_when_it_is_plotted():
    opened: list[str] = []

    def subscribe(topic: Any, _: object) -> Any:
        opened.append(topic.name)
        return nullcontext(SimpleNamespace(latest=battery(1.0, 7.0)))

    with ExitStack() as stack:
        sampler = Sampler(Subscriptions(subscribe, stack).newest)
        sampler.sample([Viewer()])
        assert opened == []
        for _ in range(2):
            sampler.sample([plotting(VOLTAGE, "sensor/battery:current")])
        assert opened == ["sensor/battery"]


def test_the_command_has_limits():
    order = {"do": "plot", "id": 1, "set": 1, "names": [VOLTAGE]}
    assert isinstance(commands.parse(json.dumps(order)), commands.PlotNumbers)
    for wrong in ({"names": [VOLTAGE] * 101}, {"names": ["x" * 101]}, {"set": -1}):
        with pytest.raises(InputError):
            commands.parse(json.dumps(order | wrong))


async def test_a_browser_asks_for_the_list_and_chooses_from_it():
    async with serving() as (station, session), connected(station, session) as socket:

        async def answer(**command: Any) -> dict[str, Any]:
            await socket.send_json({"id": 9, **command})
            while True:
                frame: dict[str, Any] = await socket.receive_json(timeout=10)
                if frame["kind"] == "answer":
                    return frame

        listed = await answer(do="numbers")
        assert VOLTAGE in listed["value"]["numbers"]
        assert (await answer(do="plot", set=1, names=[VOLTAGE]))["ok"]
        refused = await answer(do="plot", set=2, names=["state/gate:mode"])
        assert not refused["ok"]
        assert refused["text"].startswith("state/gate:mode: expected a numeric field")
        (viewer,) = station._viewers
        assert (viewer.plotted, viewer.plot_set) == ((VOLTAGE,), 1)
