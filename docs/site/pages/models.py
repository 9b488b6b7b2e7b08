"""Tables of the fields of pydantic models, from their JSON Schema."""

import json
from collections.abc import Callable, Iterator
from typing import Any

from pydantic import BaseModel

from pages.markdown import table

HUGE = 2**53
"""Larger limits only state the 64-bit range and are not shown."""

Json = dict[str, Any]
Link = Callable[[str], str | None]
"""Link to the description of a model, or None."""


class Definitions:
    """JSON Schema of a model and of all models that it contains.

    Args:
        model: Root model.
    """

    def __init__(self, model: type[BaseModel]) -> None:
        self.root: Json = model.model_json_schema()
        self._models: dict[str, Json] = self.root.get("$defs", {})

    def __getitem__(self, name: str) -> Json:
        return self._models[name]

    def models_in(self, schema: Json) -> Iterator[str]:
        """Yield the names of the models that a value may have, without enums."""
        if "$ref" in schema:
            name = schema["$ref"].rpartition("/")[2]
            if "properties" in self._models[name]:
                yield name
        for inner in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
            yield from self.models_in(inner)
        for key in ("items", "additionalProperties"):
            if isinstance(schema.get(key), dict):
                yield from self.models_in(schema[key])

    def fields(self, schema: Json, link: Link, leave_out: frozenset[str] = frozenset()) -> str:
        """Return the table of a model's fields."""
        required = schema.get("required", ())
        shown = [item for item in schema.get("properties", {}).items() if item[0] not in leave_out]
        rows = [
            (
                f"`{name}`",
                self.kind(field, link),
                "required" if name in required else self.default(field),
                self.meaning(field),
            )
            for name, field in sorted(shown, key=lambda item: "const" not in item[1])
        ]
        return table(("field", "type", "default", "meaning"), rows)

    def common(self, names: list[str]) -> frozenset[str]:
        """Return the fields that are identical in all these models."""
        first, *others = (self._models[name]["properties"] for name in names)
        alike = (name for name, field in first.items() if all(other.get(name) == field for other in others))
        return frozenset(alike) if others else frozenset()

    def meaning(self, field: Json) -> str:
        """Return a field's description, or the first paragraph of the one model that it holds."""
        if "description" in field:
            return plain(field["description"])
        names = list(self.models_in(field))
        return plain(self._models[names[0]].get("description", "")).partition("\n\n")[0] if len(names) == 1 else ""

    def kind(self, schema: Json, link: Link) -> str:
        """Return the type of a value."""
        if "$ref" in schema:
            name = schema["$ref"].rpartition("/")[2]
            model = self._models[name]
            if "properties" not in model:
                return self.kind(model, link)
            where = link(name)
            return f"[{label(model, name)}]({where})" if where else label(model, name)
        choices = schema.get("anyOf") or schema.get("oneOf")
        if choices:
            return " or ".join(dict.fromkeys(self.kind(choice, link) for choice in choices))
        if "const" in schema:
            return f"`{schema['const']}`"
        if "enum" in schema:
            return ", ".join(f"`{value}`" for value in schema["enum"])
        return self._simple(schema, link)

    def _simple(self, schema: Json, link: Link) -> str:
        match schema.get("type"):
            case "array" if "prefixItems" in schema:
                return "(" + ", ".join(self.kind(item, link) for item in schema["prefixItems"]) + ")"
            case "array":
                return f"list of {self.kind(schema['items'], link)}" if schema.get("items") else "list"
            case "object":
                inner = schema.get("additionalProperties")
                return f"mapping to {self.kind(inner, link)}" if isinstance(inner, dict) else "mapping"
            case "null":
                return "null"
            case "string" if schema.get("format") == "path":
                return "path"
            case str(name):
                limits = _limits(schema)
                return f"{name}, {limits}" if limits else name
            case _:
                return "any"

    def default(self, field: Json) -> str:
        """Return the default of a field; for a model, only the values that differ from the model's defaults."""
        value = field.get("default")
        if "const" in field:
            return "optional"
        if not isinstance(value, dict):
            return f"`{json.dumps(value)}`"
        names = list(self.models_in(field))
        if not names:
            return f"`{json.dumps(value)}`"
        own = {name: inner.get("default") for name, inner in self._models[names[0]]["properties"].items()}
        other = {name: inner for name, inner in value.items() if own.get(name) != inner} if len(names) == 1 else value
        return ", ".join(f"`{name}: {json.dumps(inner)}`" for name, inner in other.items()) or "all its defaults"


def label(model: Json, name: str) -> str:
    """Return the kind of a model, else its title."""
    if name.startswith("Device_"):
        return "device"
    kind = model.get("properties", {}).get("kind", {}).get("const")
    return f"`{kind}`" if kind else str(model.get("title", name))


def plain(text: str) -> str:
    """Return a docstring as Markdown."""
    return text.replace("``", "`").strip()


def _limits(schema: Json) -> str:
    said = []
    for key, sign in (("minimum", ">="), ("exclusiveMinimum", ">"), ("maximum", "<="), ("exclusiveMaximum", "<")):
        if key in schema and abs(schema[key]) < HUGE:
            said.append(f"{sign} {schema[key]:.6g}")
    if "minLength" in schema or "maxLength" in schema:
        said.append(f"{schema.get('minLength', 0)} to {schema.get('maxLength', 'any number of')} characters")
    if "pattern" in schema:
        said.append(f"`{schema['pattern']}`")
    return ", ".join(said)
