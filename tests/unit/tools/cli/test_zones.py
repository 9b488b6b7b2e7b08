"""``zone``: what a command line asks for, what is refused before a robot is asked, and the table."""

from typer.testing import CliRunner

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.zones import ZoneOrder
from monstertruckd.tools.cli import zones
from monstertruckd.tools.cli.main import app
from tests.unit.planners.zones.zone_kit import zone

CORNERS = ("2,-0.5", "3,-0.5", "3,0.5")


def run(*arguments: str):
    return CliRunner().invoke(app, ["zone", *arguments])


def test_orders_are_what_the_command_line_says(monkeypatch):
    asked = []
    monkeypatch.setattr(zones, "_order", lambda order, robot, endpoint, *what: asked.append((order, *what)))
    assert run("add", "stairs", *CORNERS, "--leave").exit_code == 0
    assert run("add", "ramp", *CORNERS, "--limit", "0.1").exit_code == 0
    assert run("off", "stairs", "--for", "20min").stderr == "stairs is off for 1200 s\n"
    assert run("on", "stairs").exit_code == run("remove", "stairs").exit_code == 0
    (_, _, stairs), (_, _, ramp), *others = asked
    assert (stairs.kind, stairs.inside, stairs.corners[0]) == ("keepout", "leave", (2.0, -0.5))
    assert (ramp.kind, ramp.limit) == ("speed", 0.1)
    assert others == [
        (ZoneOrder.OFF, "stairs", None, 1200.0),
        (ZoneOrder.ON, "stairs"),
        (ZoneOrder.REMOVE, "stairs"),
    ]


def test_impossible_zones_are_refused_by_what_is_wrong():
    for arguments, said in (
        (("add", "a", "1,2", "3"), "corner '3': expected x,y in metres"),
        (("add", "a", "1,2", "3,4"), "corners"),
        (("add", "a", "0,0", "1,0", "2,0"), "expected a polygon of at least 1 cm^2"),
        (("add", "a", *CORNERS, "--limit", "-1"), "limit"),
        (("off", "a", "--for", "25h"), "expected at most 24h"),
    ):
        done = run(*arguments)
        assert (done.exit_code, said in done.stderr) == (Reason.BAD_INPUT.exit_code, True), done.stderr


def test_a_row_says_what_the_zone_is_and_whether_it_is_in_force():
    ramp = zone("ramp", kind="speed", limit=0.1, saved=True, off_until=9 * SECOND)
    assert zones.row_of(ramp, inside=True, now=4 * SECOND) == (
        "ramp", "speed", "0.1", "", "4 corners", "operator", "off for 5 s, robot inside"
    )  # fmt: skip
    assert zones.row_of(zone(), inside=False, now=0)[3:] == ("stop", "4 corners", "configuration", "on")
