"""The command group: tables, JSON, pictures, refusals."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruck_kinematics.se2 import integrate
from monstertruck_kinematics.unsteered import SkidSteer
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.kinematics import app


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def run_json(*arguments):
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    return json.loads(run(*arguments, "--json"), parse_constant=refuse)


def test_show_lists_every_family_and_one_in_detail():
    listed = {row["family"]: row for row in run_json("show")}
    assert listed["truck"]["class"] == [1, 2]
    assert listed["mecanum"]["non_holonomic"] is False
    assert "tricycle" in run("show")
    (one,) = run_json("show", "truck", "-s", "track=0.3")
    assert one["parameters"]["track"] == 0.3
    assert "cg_split" in run("show", "truck")


def test_mobility_of_a_family_and_of_any_wheels(tmp_path):
    found = run_json("mobility", "truck", "0.2", "0.3", "-0.3")
    assert found["turning_centre"] == "point"
    assert found["turning_centre_at"] == pytest.approx([0.0, 0.16 / np.tan(0.3)], abs=1e-12)
    assert "front left" in run("mobility")
    wheels = tmp_path / "wheels.yaml"
    wheels.write_text(
        "- {kind: fixed, name: l, x: 0, y: 0.2, radius: 0.1}\n"
        "- {kind: fixed, name: r, x: 0, y: -0.2, radius: 0.1}\n"
        "- {kind: steered, x: 0.5, y: 0, radius: 0.1, heading: 0.3}\n"
        "- {kind: caster, x: 0.5, y: 0.1, radius: 0.1, offset: 0.02}\n"
    )
    found = run_json("mobility", "--wheels", wheels)
    assert (found["mobility"], found["steerability"]) == (1, 1)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{a: 1}", "expected a list of wheels"),
        ("- {kind: square}", "wheel 1: expected a mapping with kind"),
        ("- {kind: fixed, x: 0, y: 0}", "wheel 1: .*radius"),
        ("- {kind: fixed, x: 0, y: 0, radius: 1, colour: red}", "wheel 1: .*colour"),
        ("- {kind: fixed, x: 0, y: 0, radius: big}", "wheel 1: .*radius is 'big': expected a number"),
        ("- {kind: fixed, x: 0, y: 0, radius: -1}", "wheel 1: radius is -1"),
        ("[", ":1: not valid YAML"),
        ("[]", "wheels is empty"),
    ],
)
def test_bad_wheel_files_are_refused(tmp_path, text, complaint):
    wheels = tmp_path / "wheels.yaml"
    wheels.write_text(text)
    with pytest.raises(InputError, match=complaint):
        run("mobility", "--wheels", wheels)


def test_radius_table():
    table = {(r["mode"], r["limit_deg"]): r for r in run_json("radius-table", "-l", "25")}
    assert round(table["counter", 25.0]["radius"], 3) == 0.343
    assert round(table["front", 25.0]["radius_every_wheel"], 3) == 0.816
    assert table["crab", 25.0]["radius"] is None
    assert "0.757" in run("radius-table")


def test_linkage():
    table = run_json("linkage", "--arms", "forward")
    at = table["servo"].index(pytest.approx(np.radians(20.0)))
    assert round(np.degrees(table["linkage_left"][at]), 2) == 15.82
    assert np.degrees(table["servo"][0]) == pytest.approx(-45.0)
    tight = run_json("linkage", "--pitman", "0.03")
    assert np.degrees(tight["servo"][0]) > -45.0  # only as far as the linkage moves
    assert "-26.26" in run("linkage")
    assert "-26.26" not in run("linkage", "--polynomials", "2016")


@pytest.mark.parametrize("command", ["mobility", "radius-table", "linkage", "fit"])
def test_pictures(tmp_path, command):
    picture = tmp_path / "picture.png"
    options = {"fit": ["--model", "symmetric"], "mobility": ["truck", "0.2", "0.3", "-0.1"]}.get(command, [])
    run(command, *options, "--png", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    below = tmp_path / "made" / "picture.png"
    run(command, *options, "--png", below)
    assert below.is_file(), "its folder is made"
    with pytest.raises(InputError, match="cannot be drawn"):
        run(command, *options, "--png", picture / "picture.png")


def test_fit_of_the_paper():
    found = run_json("fit", "--model", "symmetric")
    errors = found["radius_and_speed_errors_percent"]
    assert np.abs(errors["symmetric, max"]).max() == pytest.approx(16.98, abs=0.02)
    assert np.abs(errors["ideal"]).max() == pytest.approx(32.26, abs=0.01)
    assert found["worst_percent_on_the_driven_ratios_alone"]["symmetric"] <= 5.5
    assert found["worst_percent_on_the_radii_alone"]["symmetric"] == pytest.approx(16.98, abs=0.02)
    assert found["unexplained_percent"] == pytest.approx(3.24, abs=0.01)
    assert "differ by up to 3.2 %" in run("fit", "--model", "icr", "--no-bounded")


def test_fit_of_a_trajectory(tmp_path):
    robot = SkidSteer(0.05, 0.2, -0.2, 0.0, 0.95, 0.95)
    pose, lines = (0.0, 0.0, 0.0), ["time,left,right,x,y,heading"]
    for k in range(120):
        rates = (1.0 + 0.5 * np.sin(0.1 * k), 1.0 + 0.5 * np.cos(0.07 * k))
        lines.append(",".join(f"{v:.9g}" for v in (0.1 * k, *rates, *pose)))
        pose = integrate(pose, *robot.forward(tuple(map(float, rates))), 0.1)
    path = tmp_path / "trajectory.csv"
    path.write_text("\n".join(lines))
    options = ("fit", path, "--radius", "0.05", "--half-track", "0.15", "--model", "symmetric")
    (found,) = run_json(*options)
    assert found["parameters"]["gain"][0] == pytest.approx(0.95, abs=1e-3)
    assert found["parameters"]["half_track"][0] == pytest.approx(0.2, abs=1e-3)
    assert "half_track" in run(*options)
    for broken, complaint in (("1,2,3", "trajectory.csv:122: 3 columns"), ("1,2,3,x,5,6", "trajectory.csv:122: .*'x'")):
        path.write_text("\n".join([*lines, broken]))
        with pytest.raises(InputError, match=complaint):
            run(*options)
    path.write_text("")
    with pytest.raises(InputError, match="window"):
        run(*options)


def test_refusals():
    for arguments, complaint in (
        (("show", "hovercraft"), "family 'hovercraft'"),
        (("show", "truck", "-s", "wheelbase"), "--set wheelbase: expected name=value"),
        (("mobility", "truck", "0.2"), "expected 3"),
        (("mobility", "-w", "nowhere.yaml"), "nowhere.yaml"),
        (("radius-table", "-l", "-5"), "limit is"),
        (("linkage", "--arms", "up"), "arms is 'up'"),
        (("linkage", "--polynomials", "1999"), "1999"),
        (("fit", "--model", "rubber"), "rubber"),
        (("fit", "nowhere.csv"), "nowhere.csv"),
    ):
        with pytest.raises(InputError, match=complaint):
            run(*arguments)
