"""Python, packages, configuration, the service's files and rights."""

from dataclasses import replace
from pathlib import Path

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.context import Account, HostContext, Level, account_of, inspect
from monstertruckd.tools.doctor.software import (
    configuration,
    contact,
    motion,
    packages,
    python,
    rights,
    rules,
    sensors,
    service,
)
from monstertruckd.tools.install.plan import RULES, UNIT
from tests.unit.tools.doctor.kit import EmulatedHost, bad, see
from tests.unit.tools.install.kit import PROGRAM, ROOT, TRUCK

REQUIRES = [
    "numpy>=2",
    'mcap>=1.3; extra == "robot"',
    'rerun-sdk; extra == "view"',
    'monstertruckd[logs]; extra == "view"',
]
INSTALL = f"sudo /opt/monstertruckd/.venv/bin/python -m monstertruckd install-service --config {TRUCK}"


def without(*absent: str):
    def change(emulated: EmulatedHost) -> None:
        emulated.context = replace(emulated.context, versions=lambda name: None if name in absent else "1.0")

    return change


def test_a_processor_without_wheels_is_reported(tmp_path: Path):
    assert bad(see(tmp_path / "a", lambda context: python(context, "x86_64"))) == {}
    found = see(tmp_path / "b", lambda context: python(context, "armv7l"))["python"]
    assert (found.level, found.reason) == (Level.WARN, Reason.NOT_SUPPORTED)


def test_packages_of_a_robot_must_be_there_others_may(tmp_path: Path):
    def check(context: HostContext):
        return packages(context, REQUIRES)

    found = see(tmp_path / "a", check, without("rerun-sdk"))
    assert bad(found) == {}
    assert found["extras"].seen == "installed: none; incomplete: view (rerun-sdk)"
    ours = [*REQUIRES, "pytest>=8; extra == 'dev'", "mkdocs-material>=9; extra == 'docs'"]
    found = see(tmp_path / "d", lambda context: packages(context, ours), without("pytest"))
    assert found["extras"].seen == "installed: view; incomplete, needed for development only: dev"
    lacking = see(tmp_path / "b", check, without("mcap", "numpy"))["packages"]
    assert lacking.reason is Reason.NOT_INSTALLED
    assert lacking.seen == "missing: numpy, mcap"
    assert lacking.fix == "/opt/monstertruckd/.venv/bin/python -m pip install 'numpy>=2' 'mcap>=1.3'"

    def in_a_checkout(emulated: EmulatedHost) -> None:
        without("mcap")(emulated)
        program = replace(emulated.context.program, neutral=ROOT / "systemd" / "neutral.py")
        emulated.context = replace(emulated.context, program=program)

    fix = see(tmp_path / "c", check, in_a_checkout)["packages"].fix
    assert fix == f"cd {ROOT} && python3 -m monstertruckd.bootstrap sync"


def test_limits_that_are_weaker_than_the_defaults_are_a_warning(tmp_path: Path):
    assert bad(see(tmp_path / "a", configuration)) == {}
    found = see(tmp_path / "b", configuration, lambda emulated: emulated.change(gate={"tilt": {"stop": 0.5}}))["safety"]
    assert (found.level, found.reason, found.seen) == (
        Level.WARN, Reason.WEAKENED, "gate.tilt.stop 0.5, default 0.35",
    )  # fmt: skip


def test_the_configuration_is_the_named_one_else_the_services(tmp_path: Path):
    def admitted(emulated: EmulatedHost) -> None:
        emulated.context = inspect(emulated.folder, PROGRAM, None, 0, emulated.clock)

    found = see(tmp_path / "a", configuration, admitted)["config"]
    assert found.level is Level.OK
    assert found.seen == str(tmp_path / "a/etc/monstertruckd/truck.yaml")

    def refused(emulated: EmulatedHost) -> None:
        emulated.put("etc/monstertruckd/truck.yaml", "version: 1\ndevices: {}\nspeed: 9\n")
        admitted(emulated)

    found = see(tmp_path / "b", configuration, refused)["config"]
    assert found.reason is Reason.BAD_CONFIG
    assert "truck.yaml:3: speed: unknown key" in found.seen
    assert found.fix is not None
    assert " config show " in found.fix

    def nothing(emulated: EmulatedHost) -> None:
        emulated.context = inspect(emulated.folder / "nowhere", PROGRAM, None, 0, emulated.clock)

    found = see(tmp_path / "c", configuration, nothing)["config"]
    assert (found.level, found.reason) == (Level.WARN, Reason.NOT_FOUND)


def test_the_service_as_installed_now(tmp_path: Path):
    assert bad(see(tmp_path / "a", service)) == {}

    def gone(emulated: EmulatedHost) -> None:
        (emulated.folder / UNIT.relative_to("/")).unlink()

    found = see(tmp_path / "b", service, gone)["service"]
    assert (found.level, found.reason, found.fix) == (Level.WARN, Reason.NOT_INSTALLED, INSTALL)

    def old(emulated: EmulatedHost) -> None:
        emulated.put(str(UNIT.relative_to("/")), "[Service]\nUser=monstertruckd\n")

    found = see(tmp_path / "c", service, old)["service"]
    assert found.seen == "installed, but differs from a new installation: monstertruckd.service"
    assert found.fix == INSTALL


def test_what_systemd_says_of_it(tmp_path: Path):
    def saying(said: str):
        return lambda emulated: emulated.runs(systemctl=(0, said))

    assert see(tmp_path / "a", service, saying("ActiveState=active\nNRestarts=0"))["service runs"].seen == "active"
    found = see(tmp_path / "b", service, saying("ActiveState=active\nNRestarts=7"))["service runs"]
    assert (found.level, found.seen) == (Level.WARN, "active, 7 restarts")
    found = see(tmp_path / "c", service, saying("ActiveState=failed\nNRestarts=2"))["service runs"]
    assert (found.level, found.reason) == (Level.FAIL, Reason.SERVICE_FAILED)
    assert found.fix == "journalctl -u monstertruckd.service -e"


def test_rules_that_are_missing_or_old(tmp_path: Path):
    place = str(RULES.relative_to("/"))
    assert bad(see(tmp_path / "a", rules)) == {}
    missing = see(tmp_path / "b", rules, lambda emulated: (emulated.folder / place).unlink())["udev rules"]
    assert (missing.reason, missing.fix) == (Reason.NOT_INSTALLED, INSTALL)
    old = see(tmp_path / "c", rules, lambda emulated: (emulated.put(place, "# of yesterday\n"), None)[1])["udev rules"]
    assert old.seen.endswith("is older than the config")


def test_modem_manager_is_harmless_with_the_rules(tmp_path: Path):
    def running(emulated: EmulatedHost) -> None:
        emulated.process(77, "/usr/sbin/ModemManager")

    def without_rules(emulated: EmulatedHost) -> None:
        running(emulated)
        (emulated.folder / RULES.relative_to("/")).unlink()

    assert see(tmp_path / "a", rules)["ModemManager"].seen == "does not run"
    assert see(tmp_path / "b", rules, running)["ModemManager"].seen == "runs, but ignores the robot's ports"
    assert see(tmp_path / "c", rules, without_rules)["ModemManager"].level is Level.WARN


def test_rights_of_the_services_user(tmp_path: Path):
    assert bad(see(tmp_path / "a", rights)) == {}

    def outsider(emulated: EmulatedHost) -> None:
        emulated.context = replace(emulated.context, account=Account("pi", 64_998, {"pi": 64_998}))

    found = bad(see(tmp_path / "b", rights, outsider))
    assert found["user"].fix == "sudo usermod -aG dialout,video pi"
    assert found["lidar rights"].reason is Reason.NOT_PERMITTED
    assert found["lidar rights"].fix == "sudo usermod -aG dialout,video pi"
    assert found["logs"].reason is Reason.RECORDING_FAILED

    def locked(emulated: EmulatedHost) -> None:
        (emulated.folder / "dev" / "ttyUSB0").chmod(0o600)

    (found,) = bad(see(tmp_path / "c", rights, locked)).values()
    node = tmp_path / "c/dev/ttyUSB0"
    assert found.fix == f"sudo chgrp dialout {node} && sudo chmod g+rw {node}"

    def nobody(emulated: EmulatedHost) -> None:
        emulated.context = replace(emulated.context, account=None)

    assert see(tmp_path / "d", rights, nobody)["user"].seen == "the service's user does not exist"


def test_accounts_are_read_from_the_systems_own_files(tmp_path: Path):
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/passwd").write_text("root:x:0:0::/root:/bin/sh\npi:x:1000:1000::/home/pi:/bin/sh\n")
    (tmp_path / "etc/group").write_text("root:x:0:\npi:x:1000:\ndialout:x:20:anna,pi\nvideo:x:44:anna\nbroken\n")
    pi = Account("pi", 1000, {"pi": 1000, "dialout": 20})
    assert account_of(tmp_path, "pi") == account_of(tmp_path, 1000) == pi
    assert account_of(tmp_path, "eva") is None


def test_measures_of_the_motion_and_what_is_missing(tmp_path: Path):
    found = see(tmp_path / "a", motion, without())
    assert bad(found) == {}
    assert found["motion"].seen == "measured by wheels, scans, compass"
    assert bad(see(tmp_path / "b", motion, without("kiss-icp"))).keys() == {"scan odometry"}
    for name in ("numba", "scipy"):
        missing = see(tmp_path / name, motion, without(name))["scan odometry"]
        assert missing.seen == f"{name} not installed: the motion is not measured by scans"
    alone = see(tmp_path / "c", motion, lambda emulated: emulated.change(consistency=None))["motion"]
    assert (alone.level, alone.reason) == (Level.WARN, Reason.UNWITNESSED)


def test_measures_of_a_contact_and_the_limit_without_one(tmp_path: Path):
    assert see(tmp_path / "a", contact, without())["contact"].seen == "shown by motor current, scans"
    by_current = see(tmp_path / "b", contact, lambda emulated: emulated.change(consistency=None))["contact"]
    assert by_current.seen == "shown by motor current"
    nothing = see(tmp_path / "c", contact, lambda emulated: emulated.change(gate={"contact": None}))["contact"]
    assert (nothing.level, nothing.reason) == (Level.WARN, Reason.CONTACT)
    assert "at up to 0.21 m/s and pushes with up to 25 N" in nothing.seen


def test_a_gate_that_waits_for_a_sensor_that_the_robot_does_not_have(tmp_path: Path):
    def lacking(folder: str, gate: dict[str, object]) -> dict[str, Reason | None]:
        def change(emulated: EmulatedHost) -> None:
            assert emulated.context.config is not None
            devices = emulated.context.config.devices.model_dump() | {"lidar": None, "compass": None}
            emulated.change(devices=devices, gate=gate, slam=None, explorer=None, planner=None, tracker=None)

        return {name: finding.reason for name, finding in see(tmp_path / folder, sensors, change).items()}

    assert see(tmp_path / "a", sensors, without()) == {}
    assert lacking("b", {"speed": 0.1, "reverse_speed": 0.1}) == {
        "attitude": Reason.ATTITUDE_STALE,
        "scan": Reason.SCAN_STALE,
    }
    unseeing = {"speed": 0.1, "reverse_speed": 0.1, "scan": {"stale_after": 0.25, "critical": False}}
    assert lacking("c", unseeing) == {"attitude": Reason.ATTITUDE_STALE}
    assert lacking("d", unseeing | {"attitude": None}) == {}
