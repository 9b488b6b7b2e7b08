"""Commands that name no endpoint: with several robots on this computer they say which there are, and reach none."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from monstertruck_runtime import client, robots
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, public, robot_on_host
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.truck import Truck
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.station.address import RobotAddress
from monstertruckd.tools.cli import options, orders
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.cli.orders import OrderOutcome
from tests.unit.tools.cli.test_shared_options import commands

SOCKETS = {"truck": "unixsock-stream//run/x/7447.sock", "second": "unixsock-stream//run/x/7448.sock"}


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Two robots on this computer; what commands reach is kept, and nothing is done."""
    found: list[tuple[str, str]] = []
    monkeypatch.setattr(robots, "local_endpoints", lambda **_: list(SOCKETS.values()))
    monkeypatch.setattr(orders, "local_endpoints", lambda **_: list(SOCKETS.values()))
    for module in (robots, options):
        monkeypatch.setattr(
            module, "nearest", lambda endpoint: SOCKETS["truck"] if endpoint == DEFAULT_ENDPOINT else endpoint
        )
    monkeypatch.setattr(robots, "robots_here", lambda *_: list(SOCKETS.items()))
    monkeypatch.setattr(orders, "robots_here", lambda *_: list(SOCKETS.items()))

    def stop(_: Any, robot: str, endpoint: str, *__: Any, **___: Any) -> None:
        found.append((robot, endpoint))
        raise InputError("reached")

    for module in ("orders", "goto", "settings"):
        monkeypatch.setattr(f"monstertruckd.tools.cli.{module}.with_robot", stop)
    return found


@pytest.mark.parametrize(
    "line",
    [
        "arm",
        "disarm",
        "reset",
        "goto 1 2 0",
        "track configs/paths/bend.csv",
        "path lap",
        "explore",
        "set gate.speed 0.1",
    ],
)
def test_a_command_that_could_mean_two_robots_is_refused_with_the_list(line: str, reached: list):
    done = CliRunner().invoke(app, line.split())
    assert done.exit_code == Reason.BAD_INPUT.exit_code
    assert " ".join(done.output.split()) == (
        "2 robots answer on this computer; choose one: --robot truck --endpoint tcp/127.0.0.1:7447, "
        "--robot second --endpoint tcp/127.0.0.1:7448"
    )
    assert reached == []


def test_every_command_that_reaches_a_robot_looks_first_which_there_are():
    blind = {
        name
        for name, command in commands(typer.main.get_command(app))
        if any("--endpoint" in parameter.opts and parameter.callback is None for parameter in command.params)
    }
    assert blind == {"replay", "security check"}, "replay is a robot itself; security check requires an endpoint"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--robot", "second"], ("second", SOCKETS["second"])),
        (["--robot", "truck"], ("truck", SOCKETS["truck"])),
        (["--robot", "nobody"], ("nobody", SOCKETS["truck"])),
        (["--endpoint", "tcp/127.0.0.1:7450"], ("truck", "tcp/127.0.0.1:7450")),
    ],
)
def test_a_name_or_an_endpoint_tells_them_apart(words: list[str], expected: tuple[str, str], reached: list):
    CliRunner().invoke(app, ["disarm", *words])
    assert reached == [expected]


def test_robots_of_one_name_are_listed_with_their_endpoints(reached: list, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robots, "robots_here", lambda: [("truck", endpoint) for endpoint in SOCKETS.values()])
    done = CliRunner().invoke(app, ["disarm", "--robot", "truck"])
    assert "--robot truck --endpoint tcp/127.0.0.1:7448" in " ".join(done.output.split())
    assert reached == []


def test_one_robot_needs_no_name_and_a_named_one_no_question(reached: list, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robots, "local_endpoints", lambda: [SOCKETS["truck"]])
    monkeypatch.setattr(robots, "robots_here", lambda: [("truck", SOCKETS["truck"])])
    CliRunner().invoke(app, ["disarm"])
    assert reached == [("truck", SOCKETS["truck"])]
    monkeypatch.setattr(robots, "robots_here", lambda: pytest.fail("asked for nothing"))
    CliRunner().invoke(app, ["disarm", "--robot", "truck"])
    assert reached == 2 * [("truck", SOCKETS["truck"])]


def test_several_robots_behind_one_endpoint_are_refused_too(reached: list, monkeypatch: pytest.MonkeyPatch):
    """It is that of a fleet's router, or of a robot that is connected to one."""
    monkeypatch.setattr(robots, "local_endpoints", lambda: [SOCKETS["truck"]])
    monkeypatch.setattr(robots, "robots_here", lambda: [("ann", SOCKETS["truck"]), ("truck", SOCKETS["truck"])])
    done = CliRunner().invoke(app, ["disarm"])
    assert done.exit_code == Reason.BAD_INPUT.exit_code
    assert "2 robots answer on this computer; choose one: --robot ann" in " ".join(done.output.split())
    assert reached == []


@pytest.mark.parametrize("listens", [False, True], ids=["no program", "another program"])
def test_a_robot_elsewhere_is_named_but_not_reached_unasked(
    listens: bool, reached: list, monkeypatch: pytest.MonkeyPatch
):
    """At the default port nothing listens, or a program that is no robot."""
    monkeypatch.setattr(robots, "nearest", lambda endpoint: endpoint)
    there = [*[DEFAULT_ENDPOINT] * listens, SOCKETS["second"]]
    monkeypatch.setattr(robots, "local_endpoints", lambda: there)
    monkeypatch.setattr(robots, "robots_here", lambda: [("second", SOCKETS["second"])])
    done = CliRunner().invoke(app, ["disarm"])
    assert done.exit_code == Reason.BAD_INPUT.exit_code
    assert " ".join(done.output.split()) == (
        f"no robot answers at {DEFAULT_ENDPOINT}; another one does on this computer: "
        "--robot second --endpoint tcp/127.0.0.1:7448"
    )
    assert reached == []
    CliRunner().invoke(app, ["disarm", "--robot", "second"])
    assert reached == [("second", SOCKETS["second"])]


def test_nobody_answers_on_this_computer(reached: list, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robots, "nearest", lambda endpoint: endpoint)
    monkeypatch.setattr(robots, "local_endpoints", lambda **_: [])
    CliRunner().invoke(app, ["disarm"])
    assert reached == [("truck", DEFAULT_ENDPOINT)]


# Scripts


@pytest.mark.parametrize("make", [TruckClient, Truck])
def test_a_script_that_could_mean_two_robots_is_refused_with_the_list(make: Callable[[], Any], reached: list):
    def enter() -> None:
        if make is Truck:
            with Truck():
                pass
        else:
            asyncio.run(TruckClient().__aenter__())

    with pytest.raises(InputError) as refused:
        enter()
    assert str(refused.value) == (
        "2 robots answer on this computer; choose one: 'truck', 'tcp/127.0.0.1:7447', 'second', 'tcp/127.0.0.1:7448'"
    )


def test_a_script_reaches_the_robot_that_it_names(reached: list, monkeypatch: pytest.MonkeyPatch):
    opened: list[str] = []

    def config(endpoint: str, *_: Any) -> Any:
        opened.append(endpoint)
        raise NotFoundError("reached")

    monkeypatch.setattr(client, "session_config", config)
    for made in (TruckClient("second"), TruckClient(endpoint="tcp/127.0.0.1:7450"), TruckClient("a", "tcp/b:1")):
        with pytest.raises(NotFoundError, match="reached"):
            asyncio.run(made.__aenter__())
    assert opened == [SOCKETS["second"], "tcp/127.0.0.1:7450", "tcp/b:1"]


# Stations


def test_a_station_that_could_mean_two_robots_is_refused_with_the_list(reached: list):
    done = CliRunner().invoke(app, ["station"])
    assert done.exit_code == Reason.BAD_INPUT.exit_code
    assert " ".join(done.output.split()) == (
        "2 robots answer on this computer; choose one: --robot truck@tcp/127.0.0.1:7447, "
        "--robot second@tcp/127.0.0.1:7448"
    )


def test_a_station_shows_the_robot_that_it_names(reached: list, monkeypatch: pytest.MonkeyPatch):
    assert RobotAddress.parse("second") == RobotAddress("second", SOCKETS["second"])
    assert RobotAddress.parse("nobody") == RobotAddress("nobody", SOCKETS["truck"])
    monkeypatch.setattr(robots, "robots_here", lambda: [("truck", SOCKETS["truck"])])
    assert RobotAddress.default() == RobotAddress("truck", SOCKETS["truck"])


def test_an_emergency_stop_is_never_refused_and_names_who_was_not_stopped(
    reached: list, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    CliRunner().invoke(app, ["estop"])
    assert reached == [("truck", SOCKETS["truck"])]
    state = GateState(stamp=1, received=1, seq=0, mode=GateMode.ESTOPPED, nonce="n", speed_limit=0.0)
    outcome = OrderOutcome(Order.ESTOP, Reason.OK, "", state)
    monkeypatch.setattr(orders, "with_robot", lambda *_, **__: outcome)
    orders.estop("truck", SOCKETS["truck"])
    assert capsys.readouterr().err == (
        "not stopped: second: monstertruckd estop --robot second --endpoint tcp/127.0.0.1:7448\n"
    )


def test_where_a_robot_is():
    assert robot_on_host("truck", "tls/rover.local:7447") == "truck on rover.local"
    here = robot_on_host("truck", DEFAULT_ENDPOINT)
    assert here == robot_on_host("truck", SOCKETS["truck"])
    assert here != "truck on 127.0.0.1"
    assert public("tcp/10.0.0.3:7447") == "tcp/10.0.0.3:7447"
