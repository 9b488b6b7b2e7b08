"""Catalogs: our rows, and those of distributions that are installed with us."""

import asyncio
import json
import re
from dataclasses import dataclass
from typing import Annotated, Literal

import pytest
from pydantic import TypeAdapter, ValidationError

from monstertruck_runtime.actors.remote import StepCodec
from monstertruck_runtime.errors import DeviceLostError, InputError
from monstertruck_runtime.plugins import Catalog, Plugin, classes_in, kind_of
from monstertruck_schemas.base import Schema
from tests.plugin_kit import install

__all__ = ["install"]

GROUP = "monstertruck.toys"


class BallConfig(Schema):
    kind: Literal["ball"] = "ball"
    size: float = 1.0


class CubeConfig(Schema):
    kind: Literal["cube"]


def row(name, settings, implementation="json:dumps", **more):
    return Plugin(name=name, settings=f"{__name__}:{settings}", implementation=implementation, doc="A toy", **more)


def toys():
    return Catalog(GROUP, row("ball", "BallConfig"), row("cube", "CubeConfig", "no_such_module:Cube", extra="toys"))


TOP = """
from typing import Literal
from monstertruck_runtime.plugins import Plugin
from monstertruck_schemas.base import Schema

class TopConfig(Schema):
    kind: Literal["top"]
    turns: int = 3

TOP = Plugin(name="top", settings="spinning:TopConfig", implementation="spinning:TopConfig", doc="It spins")
BALL = Plugin(name="ball", settings="spinning:TopConfig", implementation="spinning:TopConfig", doc="Another ball")
WRONG = Plugin(name="wrong", settings="spinning:TopConfig", implementation="spinning:TopConfig", doc="Not of its kind")
PLAIN = Plugin(name="plain", settings="json:dumps", implementation="json:dumps", doc="No settings")
"""


def test_a_catalog_names_its_kinds_and_loads_them_on_use():
    catalog = toys()
    assert list(catalog) == ["ball", "cube"]
    assert catalog.origin("ball") == "monstertruckd"
    assert catalog.implementation(BallConfig()) is json.dumps
    with pytest.raises(InputError, match=r"cube: \S+: needs the extra \[toys\]: No module named 'no_such"):
        catalog.implementation(CubeConfig(kind="cube"))
    with pytest.raises(InputError, match="no kind 'kite': expected one of ball, cube"):
        catalog.find("kite")


def test_another_distribution_adds_a_kind(install):
    install("spinning-top", "spinning", TOP, {f"{GROUP}:top": "spinning:TOP"})
    catalog = toys()
    assert list(catalog) == ["ball", "cube", "top"]
    assert catalog.origin("top") == "spinning-top 1.0"
    read = TypeAdapter(Annotated[Schema, catalog.section()])
    config = read.validate_json('{"kind": "top", "turns": 5}')
    assert config.turns == 5
    assert catalog.implementation(config) is type(config)
    assert list(classes_in(read._type))[1:] == [BallConfig, CubeConfig, type(config)]


def test_what_is_broken_is_named_and_left_out(install):
    install(
        "spinning-top",
        "spinning",
        TOP,
        {
            f"{GROUP}:top": "spinning:TOP",
            f"{GROUP}:ball": "spinning:BALL",
            f"{GROUP}:round": "spinning:TOP",
            f"{GROUP}:wrong": "spinning:WRONG",
            f"{GROUP}:plain": "spinning:PLAIN",
            f"{GROUP}:missing": "spinning:MISSING",
            f"{GROUP}:other": "json:dumps",
        },
    )
    install("a-broken-one", "breaks", "import sys; sys.exit('no')", {f"{GROUP}:kite": "breaks:KITE"})
    install("z-later", "later", TOP.replace("spinning", "later"), {f"{GROUP}:top": "later:TOP"})
    catalog = toys()
    assert list(catalog) == ["ball", "cube", "top"]
    assert catalog.origin("top") == "spinning-top 1.0"
    reported = {(b.origin, b.name): b.error for b in catalog.broken}
    assert reported == {
        ("a-broken-one 1.0", "kite"): "SystemExit: no",
        ("spinning-top 1.0", "ball"): "the name is taken by monstertruckd",
        ("spinning-top 1.0", "missing"): "AttributeError: module 'spinning' has no attribute 'MISSING'",
        ("spinning-top 1.0", "other"): "expected a Plugin, found function",
        ("spinning-top 1.0", "plain"): "json:dumps: expected a subclass of Schema",
        ("spinning-top 1.0", "round"): "the entry point is called round, what it points to top",
        ("spinning-top 1.0", "wrong"): 'spinning:TopConfig: expected a field `kind: Literal["wrong"]`',
        ("z-later 1.0", "top"): "the name is taken by spinning-top 1.0",
    }
    assert str(catalog.broken[0]) == "monstertruck.toys: kite of a-broken-one 1.0: SystemExit: no"


def test_a_section_tells_its_models_apart_by_kind():
    read = TypeAdapter(Annotated[Schema, toys().section()])
    assert read.validate_python({"kind": "cube"}) == CubeConfig(kind="cube")
    assert read.validate_python(BallConfig(size=2.0)) == BallConfig(size=2.0)
    assert read.dump_python(BallConfig(size=2.0)) == {"kind": "ball", "size": 2.0}
    with pytest.raises(ValidationError, match=r"'kite'.*expected tags: 'ball', 'cube'"):
        read.validate_python({"kind": "kite"})
    with pytest.raises(ValidationError, match="discriminator 'kind'"):
        read.validate_python({})
    assert read.json_schema()["discriminator"]["propertyName"] == "kind"


def test_a_section_with_a_default_needs_no_kind():
    read = TypeAdapter(Annotated[Schema, toys().section("ball")])
    assert read.validate_python({"size": 3.0}) == BallConfig(size=3.0)
    assert read.validate_python({"kind": "cube"}) == CubeConfig(kind="cube")
    assert read.validate_python(BallConfig()) == BallConfig()


def test_the_kind_of_a_model():
    assert kind_of(BallConfig) == "ball"
    assert kind_of(Schema) is None


def test_settings_of_another_distribution_travel_to_another_machine(install):
    install("spinning-top", "spinning", TOP, {f"{GROUP}:top": "spinning:TOP"})
    catalog = toys()

    @dataclass
    class Task:
        toy: Annotated[Schema, catalog.section()]

    codec, top = StepCodec(Task), catalog["top"].settings_class()
    assert codec.from_json(codec.to_json(Task(top(kind="top", turns=7)))) == Task(top(kind="top", turns=7))
    with pytest.raises(InputError, match="a Plugin cannot be sent to another machine"):
        codec.to_json(catalog["top"])


class Painter:
    def __init__(self, config, *, colour):
        self.colour = colour.lower()


class HasteConfig(Schema):
    kind: Literal["haste"] = "haste"
    wait: float = "soon"


def test_an_implementation_that_takes_other_arguments_is_named():
    plugin = row("ball", "BallConfig", f"{__name__}:Painter")
    assert plugin.build(BallConfig(), colour="red").colour == "red"
    with pytest.raises(InputError, match=r"kind ball: \S+:Painter: expected to be called with \(BallConfig, hue=\)"):
        plugin.build(BallConfig(), hue="red")
    with pytest.raises(InputError, match=r"kind ball: \S+: \S+test_plugins\.py:\d+: AttributeError: 'int' object"):
        plugin.build(BallConfig(), colour=3)
    with pytest.raises(InputError, match="expected from within"), plugin.refusing("here"):
        raise InputError("expected from within")
    with pytest.raises(InputError, match=r"kind ball: \S+:GROUP: expected a class or a function, found 'monstertruck"):
        plugin.callable_at(f"{__name__}:GROUP")
    with pytest.raises(InputError, match=r"kind ball: json\.dumps: No module"):
        plugin.callable_at("json.dumps")


def test_a_mistake_in_a_task_is_named():
    async def mistake() -> None:
        raise ValueError("two motors")

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(mistake())

    plugin = row("ball", "BallConfig", f"{__name__}:Painter")
    refused = r"kind ball: here: \S+test_plugins\.py:\d+: ValueError: two motors"
    with pytest.raises(InputError, match=refused), plugin.refusing("here"):
        asyncio.run(main())


def test_an_expected_failure_of_a_task_is_no_mistake_of_the_plug_in():
    lost = DeviceLostError("cable pulled")
    with pytest.raises(DeviceLostError, match="cable pulled"), row("ball", "BallConfig", "").refusing("here"):
        raise ExceptionGroup("tasks", [ExceptionGroup("tasks", [ValueError("closed"), lost])])


def test_a_callable_without_a_signature_is_named():
    with pytest.raises(InputError, match=r"kind ball: builtins:dict: expected to be called with"):
        row("ball", "BallConfig", "builtins:dict").build(BallConfig())


def test_settings_without_a_default_are_named():
    class Wanting(Schema):
        kind: Literal["ball"] = "ball"
        size: float

    globals()["Wanting"] = Wanting
    with pytest.raises(InputError, match=r"kind ball: \S+:Wanting: size: expected a default"):
        row("ball", "Wanting").default_settings()


def test_a_default_that_its_own_field_refuses_is_named():
    assert toys().fault(row("ball", "BallConfig")) is None
    assert re.match(r"\S+:HasteConfig: wait: .*found the default 'soon'", toys().fault(row("haste", "HasteConfig")))
