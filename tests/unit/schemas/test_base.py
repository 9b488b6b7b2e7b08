"""Docstrings of fields: their meaning, in JSON Schemas and messages on bad configurations."""

from pydantic import Field

from monstertruck_schemas.base import Schema, field_docs


class Outer(Schema):
    first: int = 0
    """Of the first,

    with more of it.
    """
    bare: int = 0
    second: int = 0
    """Of the second."""
    named: int = Field(0, description="by its description")
    """Not this."""

    class Inner(Schema):
        first: int = 0
        """Of the inner."""


class Child(Outer):
    second: int = 1
    inner: Outer = Outer()
    """Of the child."""


MEANT = {"first": "Of the first,\n\nwith more of it.", "second": "Of the second.", "named": "by its description"}


def test_what_fields_mean_is_read_from_the_docstrings_behind_them():
    assert field_docs(Outer) == MEANT
    assert field_docs(Outer.Inner) == {"first": "Of the inner."}


def test_of_a_subclass_those_are_inherited_that_it_does_not_define_again():
    assert field_docs(Child) == {name: text for name, text in MEANT.items() if name != "second"} | {
        "inner": "Of the child."
    }


def test_a_class_in_a_function_has_them_and_one_without_source_has_none():
    class Local(Schema):
        first: int = 0
        """Of the local."""

    assert field_docs(Local) == {"first": "Of the local."}
    names = {"Schema": Schema, "__name__": "nowhere"}
    exec("class Typed(Schema):\n    first: int = 0\n    'Of nothing.'\n", names)
    assert field_docs(names["Typed"]) == {}


def test_json_schemas_tell_them_nested_ones_too():
    schema = Child.model_json_schema()
    assert schema["properties"]["inner"]["description"] == "Of the child."
    assert schema["$defs"]["Outer"]["properties"]["first"]["description"] == MEANT["first"]
    assert "description" not in schema["properties"]["second"]
