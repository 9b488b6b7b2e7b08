"""Roles and kinds: everything that lists devices agrees with them, and what does not fit is refused by name."""

import ast
import asyncio
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
from pydantic import ValidationError

from monstertruck_drivers.catalog import DEVICES, LIDAR, RESERVED, DeviceKind, Duty, RoleSpec, UsbIdentity, start_order
from monstertruck_drivers.config import Device, Devices, Monitors, _Devices, _Monitors
from monstertruck_drivers.emulation import EmulatorSetup
from monstertruck_drivers.usb.config import UsbConfig
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.plugins import load
from monstertruck_runtime.ports import Publisher, Subscription
from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema, field_docs
from monstertruck_schemas.entry_points import wrong_value
from monstertruck_schemas.roles import DeviceRole, ServiceName
from monstertruckd.config.load import load_truck

KINDS = list(DEVICES.values())


def test_every_role_has_a_kind_and_a_key_and_those_of_the_enum_a_row():
    assert set(DeviceRole) <= set(DEVICES.roles)
    for role in DEVICES.roles.values():
        section = Monitors if role.duty is Duty.MONITOR else Devices
        assert field_docs(section)[role.name] == role.doc
        assert DEVICES.of_role(role.name), role.name


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_driver_takes_the_ends_of_its_roles_topics(kind: DeviceKind):
    hints = get_type_hints(kind.implementation_class().__init__)
    for ends in get_args(hints.get("ends")):  # the keyword arguments of a shared base
        hints |= get_type_hints(ends)
    for role in kind.roles:
        for ends, end in ((role.writes, Publisher), (kind.also, Publisher), (role.reads, Subscription)):
            for name, topic in ends.items():
                assert end[topic.model] in (hints[name], *getattr(hints[name], "__args__", ())), (kind.name, name)
    assert {"events", "name", "clock", "config"} <= hints.keys()


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_kind_has_an_emulator_and_identifies_its_device(kind: DeviceKind):
    emulator = get_type_hints(kind.callable_at(kind.emulator))["return"]
    assert hasattr(emulator, "run")
    assert hasattr(emulator, "inject")
    taken = get_type_hints(load(kind.identity))["settings"]
    assert issubclass(kind.settings_class(), taken)


def test_devices_start_behind_a_hub_in_the_order_of_their_rows():
    assert start_order() == UsbConfig().start_order
    assert start_order()[0] == DeviceRole.DRIVE, "what stops the truck comes first"
    assert start_order()[-1] == DeviceRole.CAMERA, "what loads the bus comes last"
    assert RADAR.start < DEVICES.roles[DeviceRole.CAMERA].start, "a role without a rank of its own comes before it"


def test_kinds_are_found_by_name_and_by_role():
    assert DEVICES.named("epos") is DEVICES.named("drive_3") is DEVICES["epos"]
    with pytest.raises(
        InputError,
        match=r"unknown device 'wheel'; known: hokuyo_urg \(lidar\), hokuyo_lx \(lidar\), ld19 \(lidar\), rplidar",
    ):
        DEVICES.named("wheel")


CONFIG = """\
version: 1
devices:
  lidar: {{ port: {{ path: /dev/lidar }}, driver: {{ kind: hokuyo_urg }} }}
  {line}
"""


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        (
            "horn: { port: { path: /dev/x }, driver: { kind: os4000 } }",
            ":4: devices.horn: unknown key; expected one of ",
        ),
        ("compas: { port: { path: /dev/x }, driver: { kind: os4000 } }", "unknown key (did you mean compass?)"),
        ("compass: { port: { path: /dev/x }, driver: { kind: epos } }", ":4: devices.compass.driver.kind: "),
    ],
)
def test_a_role_without_a_row_is_refused_with_its_line_and_what_is_known(tmp_path: Path, line: str, complaint: str):
    (tmp_path / "truck.yaml").write_text(CONFIG.format(line=line))
    with pytest.raises(ConfigError) as caught:
        load_truck(tmp_path / "truck.yaml")
    assert complaint in str(caught.value)


@pytest.mark.parametrize(("role", "baud"), [("drive", 38400), ("compass", 19200), ("stabiliser", 1_000_000)])
def test_a_port_without_a_baud_has_its_devices_own(tmp_path: Path, role: str, baud: int):
    kind = DEVICES.named(role).name
    text = f"version: 1\ndevices:\n  {role}: {{ port: {{ path: /dev/x }}, driver: {{ kind: {kind} }} }}\n"
    (tmp_path / "truck.yaml").write_text(text)
    config, _ = load_truck(tmp_path / "truck.yaml")
    device = config.devices.present()[role]
    assert isinstance(device, Device)
    assert (device.port.baud, device.kind.name) == (baud, kind)


RADAR = RoleSpec(name="radar", duty=Duty.SENSOR, doc="A distance", writes={"out": topics.COMPASS})


@pytest.mark.parametrize(
    ("role", "fault"),
    [
        (RADAR, None),
        (dataclasses.replace(LIDAR, doc="another"), "role lidar: another role has the same name"),
        (dataclasses.replace(RADAR, name="so nar"), "expected a name of lower-case letters"),
        (dataclasses.replace(RADAR, writes={"out": topics.POSE}), "drivers do not write state/pose"),
        (
            dataclasses.replace(RADAR, writes={"out": dataclasses.replace(topics.COMPASS, name="sensor/radar")}),
            "no entry point sensor/radar in monstertruck.topics",
        ),
    ],
)
def test_a_role_of_another_distribution_must_fit_in(role: RoleSpec, fault: str | None):
    catalog = type(DEVICES)(*KINDS)
    kind = dataclasses.replace(DEVICES["os4000"], roles=(role,))
    found = catalog.fault(kind)
    assert (found is None) if fault is None else (found is not None and fault in found)


def kind_with(**changes: object) -> DeviceKind:
    """A kind of another distribution whose role is not quite right."""
    role = dataclasses.replace(LIDAR, name="radar", writes={"out": topics.CAMERA})
    roles = changes["roles"] if "roles" in changes else (dataclasses.replace(role, **changes),)
    return dataclasses.replace(DEVICES["hokuyo_urg"], roles=roles)


def test_services_that_are_no_device_take_their_names_from_the_table():
    root = Path(__file__).resolve().parents[3]
    names = []
    for folder in ("schemas", "planners", "drivers", "monstertruckd"):
        for file in (root / folder).rglob("*.py"):
            text = file.read_text()
            for node in ast.walk(ast.parse(text)) if "    name = " in text else ():
                if isinstance(node, ast.ClassDef) and {"run", "__aenter__"} & {
                    getattr(line, "name", "") for line in node.body
                }:
                    names += service_name(node, text)
    of_table = {f"ServiceName.{name.name}.value" for name in ServiceName}
    assert set(names) == of_table - {"ServiceName.LEVELLING.value"}, "levelling is a kind's: a default of its parameter"


def service_name(node: ast.ClassDef, module: str) -> Iterator[str]:
    """What a class gives its service for a name, there or in a constant of the module."""
    for line in node.body:
        if isinstance(line, ast.Assign) and ast.unparse(line.targets[0]) == "name":
            value = ast.unparse(line.value)
            yield re.findall(rf"^{value}\b.*= (.+)", module, re.MULTILINE)[0] if value.isupper() else value


@pytest.mark.parametrize("section", [_Devices, _Monitors])
def test_what_a_section_has_besides_its_roles_is_reserved(section: type[Schema]):
    assert {name for name in vars(section) if not name.startswith("_")} - {*vars(Schema), "model_config"} <= RESERVED


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"roles": ()}, "at least one role"),
        ({"name": "present"}, "the name is reserved"),
        ({"name": "model_config"}, "the name is reserved"),
        ({"name": "_x"}, "lower-case letters"),
        ({"name": "gate"}, "the name is reserved"),
        ({"duty": Duty.ACTUATOR}, "only this repository may define actuators"),
    ],
)
def test_a_role_that_would_harm_the_daemon_is_refused(changes, complaint):
    assert complaint in (DEVICES.fault(kind_with(**changes)) or "")


def test_two_devices_that_publish_one_topic_are_refused(monkeypatch):
    port = {"port": {"path": "/dev/a"}, "driver": {"kind": "os4000"}}
    lidar = {"port": {"path": "/dev/b"}, "driver": {"kind": "hokuyo_urg"}}
    monkeypatch.setitem(DEVICES._roles, "compass", dataclasses.replace(DEVICES.roles["compass"], writes=LIDAR.writes))
    with pytest.raises(ValidationError, match="lidar and compass both publish sensor/scan"):
        Devices.model_validate({"compass": port, "lidar": lidar}, strict=False)


SENSING = dataclasses.replace(LIDAR, duty="sensor")
LISTED = dataclasses.replace(LIDAR, writes=[topics.SCAN])
LETTERS = dataclasses.replace(LIDAR, writes={"out": dataclasses.replace(topics.SCAN, rate="7")})


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("opens", "uart", "opens: expected 'serial', 'i2c', 'video' or 'computer', found 'uart'"),
        ("baud", "9600", "baud: expected a valid integer, found '9600'"),
        ("roles", LIDAR, "roles: expected a valid tuple, found RoleSpec"),
        (
            "roles",
            (dataclasses.replace(LIDAR, duty="sensor"),),
            r"roles\[0\]\.duty: expected Duty.ACTUATOR or .* 'sensor'",
        ),
        ("roles", (LISTED,), r"roles\[0\]\.writes: expected a valid dictionary"),
        ("roles", (LETTERS,), r"roles\[0\]\.writes\['out'\]\.rate: expected a valid number, found '7'"),
        ("usb", UsbIdentity("0403:6001", "FT232R", "ttyS"), "usb.node: expected 'ttyACM', 'ttyUSB' or 'video', found"),
    ],
)
def test_a_value_that_a_field_does_not_take_is_named(field: str, value: object, said: str):
    assert wrong_value(DEVICES["ld19"]) is None
    assert re.match(said, wrong_value(dataclasses.replace(DEVICES["ld19"], **{field: value})))


def test_a_kind_says_what_its_parts_should_be():
    kind = dataclasses.replace(DEVICES["ld19"], emulator=f"{__name__}:no_emulator", identity=f"{__name__}:no_facts")
    with pytest.raises(InputError, match=r"kind ld19: \S+: expected an emulator, found dict without name, run, power"):
        kind.emulated(EmulatorSetup("lidar", None, None, None))
    with pytest.raises(
        InputError, match=r"kind ld19: \S+: range: expected a value that JSON can represent, found array"
    ):
        asyncio.run(dataclasses.replace(kind, opens="computer").identify(None, None))


def test_a_mistake_in_an_emulator_is_refused_with_its_place():
    class Broken:
        async def run(self, end):
            raise AttributeError("least")

    with pytest.raises(InputError, match=r"kind ld19: \S+: \S+test_catalog\.py:\d+: AttributeError: least"):
        asyncio.run(DEVICES["ld19"].serve(Broken(), None))


def no_emulator(setup):
    return {}


async def no_facts(where, clock, settings):
    return {"range": np.array(1)}
