"""install-service, uninstall-service and doctor as a user types them."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.main import app

TRUCK = Path(__file__).resolve().parents[4] / "configs" / "truck.yaml"


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_installing_twice_and_taking_out_twice(tmp_path: Path):
    first = run("install-service", "--config", TRUCK, "--root", tmp_path)
    assert first.exit_code == 0
    assert "new      /etc/systemd/system/monstertruckd.service" in first.stdout
    again = run("install-service", "--root", tmp_path)
    assert again.exit_code == 0
    assert again.stdout.splitlines()[-1] == "nothing to change"
    assert "new" not in again.stdout
    out = run("uninstall-service", "--root", tmp_path)
    assert "removed  /etc/udev/rules.d/70-monstertruckd.rules" in out.stdout
    assert run("uninstall-service", "--root", tmp_path).stdout == "nothing to change\n"


def test_a_dry_run_names_every_command_and_writes_nothing(tmp_path: Path):
    said = run("install-service", "--config", TRUCK, "--root", tmp_path, "--dry-run", "--json")
    value = json.loads(said.stdout)
    assert value["dry_run"]
    assert value["files"]["/etc/systemd/system/monstertruckd.service"] == "new"
    assert list(tmp_path.iterdir()) == []


def test_a_port_that_no_rule_makes_is_pointed_out(tmp_path: Path):
    file = tmp_path / "mine.yaml"
    file.write_text("version: 1\ndevices:\n  lidar: {port: {path: /dev/truck/lidar}, driver: {kind: hokuyo_urg}}\n")
    said = run("install-service", "--config", file, "--root", tmp_path)
    assert "note: devices.lidar.port: /dev/truck/lidar is not created by any udev rule" in said.stderr


def test_who_may_not_install_gets_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from monstertruckd.tools.install import apply

    def refuse(path: Path, _: str, **_options: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(apply, "replace_file", refuse)
    said = run("install-service", "--config", TRUCK, "--root", tmp_path)
    assert said.exit_code == Reason.NOT_PERMITTED.exit_code
    assert "needs root: sudo " in said.stderr


def test_the_doctor_ends_with_the_first_failure(tmp_path: Path):
    said = run("doctor", "--config", TRUCK, "--root", tmp_path, "--json")
    value = json.loads(said.stdout)
    failures = [finding for finding in value["findings"] if finding["level"] == "fail"]
    assert value["reason"] == failures[0]["reason"]
    assert said.exit_code == Reason(value["reason"]).exit_code
    assert {finding["check"] for finding in value["findings"]} >= {"python", "service", "udev rules", "lidar", "clock"}


def test_the_doctors_text_puts_the_command_below_its_finding(tmp_path: Path):
    said = run("doctor", "--config", TRUCK, "--root", tmp_path)
    lines = said.stdout.splitlines()
    at = next(number for number, line in enumerate(lines) if line.startswith("warn service "))
    assert lines[at + 1].lstrip().startswith("> sudo ")
    assert lines[at + 1].endswith(f"install-service --config {TRUCK}")
    assert "failures" in lines[-1]
    assert "not ready to drive" in said.stderr
