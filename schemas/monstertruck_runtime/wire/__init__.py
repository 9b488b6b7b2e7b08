"""Wire codec: converts topic messages to bytes and back, with the same bytes for Zenoh and MCAP.

Topics with a well-known schema are encoded as protobuf, all others as JSON with JSON Schema. Readers ignore unknown
fields; schemas only gain fields.
"""

import json
import re
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, TypeVar

from pydantic import ValidationError
from pydantic_core import PydanticSerializationError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.wire import foxglove
from monstertruck_schemas.base import Message, first_mistake
from monstertruck_schemas.topics import Topic

M = TypeVar("M", bound=Message)


_BYTE: Final = re.compile("[\udc80-\udcff]")
"""Surrogates that Python reads for undecodable bytes (PEP 383)."""


@dataclass(frozen=True, slots=True)
class WireSchema:
    """Schema of a topic in its own encoding."""

    name: str
    encoding: str
    """``protobuf`` (data: serialized FileDescriptorSet) or ``jsonschema`` (data: JSON text)."""
    data: bytes
    message_encoding: str
    """``protobuf`` or ``json``."""


def encode(topic: Topic[M], message: M) -> bytes:
    """Serialize ``message``.

    Raises:
        InputError: the message has another type than the topic, or is inconsistent.
    """
    if type(message) is not topic.model:
        msg = f"{topic.name}: expected {topic.model.__name__}, got {type(message).__name__}"
        raise InputError(msg)
    if topic.foxglove is not None:
        return foxglove.encode(message)
    try:
        return message.model_dump_json(exclude_none=True).encode()
    except PydanticSerializationError:
        return json.dumps(_escaped(message.model_dump(mode="json", exclude_none=True)), allow_nan=False).encode()


def _escaped(value: Any) -> Any:
    r"""Return ``value`` with characters outside UTF-8 escaped: undecodable bytes of a file's name become ``\xff``."""
    match value:
        case str():
            bytes_shown = _BYTE.sub(lambda byte: f"\\x{ord(byte[0]) - 0xDC00:02x}", value)
            return bytes_shown.encode("utf-8", "backslashreplace").decode()
        case dict():
            return {key: _escaped(each) for key, each in value.items()}
        case list():
            return [_escaped(each) for each in value]
        case _:
            return value


def decode(topic: Topic[M], data: bytes) -> M:
    """Parse and validate the bytes of one message; unknown fields are ignored.

    Raises:
        InputError: truncated, invalid, or out of the model's range; the text names topic and field.
    """
    try:
        if topic.foxglove is None:
            return topic.model.model_validate_json(data, extra="ignore")
        return foxglove.decode(topic.model, data)
    except ValidationError as error:
        raise InputError(f"{topic.name}: {first_mistake(error)}") from None
    except InputError as error:
        msg = f"{topic.name}: {error}"
        raise InputError(msg) from None


@cache
def encoding(topic: Topic[Any]) -> str:
    """Zenoh encoding: media type, schema name and version."""
    media = "application/json" if topic.foxglove is None else "application/protobuf"
    wire_version = 1  # version of every schema; counts changes that are not plain growth
    return f"{media};{topic.schema_name};v={wire_version}"


@cache
def schema(topic: Topic[Any]) -> WireSchema:
    """Schema of the topic for MCAP and the schema queryable."""
    if topic.foxglove is None:
        text = json.dumps(_flat(topic.model.model_json_schema()), separators=(",", ":"))
        return WireSchema(topic.schema_name, "jsonschema", text.encode(), "json")
    return WireSchema(topic.schema_name, "protobuf", foxglove.descriptor_set(topic.foxglove), "protobuf")


def _flat(root: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema without references and unions, which log viewers do not support.

    An optional value may be missing: ``encode`` omits nulls.
    """
    definitions = root.pop("$defs", {})

    def flatten(node: Any) -> Any:
        if isinstance(node, list):
            return [flatten(item) for item in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            target = definitions[node["$ref"].rpartition("/")[2]]
            return flatten(target | {key: value for key, value in node.items() if key != "$ref"})
        present = [option for option in node.get("anyOf", ()) if option.get("type") != "null"]
        if len(present) == 1:
            rest = {key: value for key, value in node.items() if key not in {"anyOf", "default"}}
            return flatten(present[0] | rest)
        flat = {key: flatten(value) for key, value in node.items()}
        if flat.get("type") == "object":
            flat.setdefault("properties", {})
            flat.pop("additionalProperties", None)
        return flat

    flat: dict[str, Any] = flatten(root)
    return flat
