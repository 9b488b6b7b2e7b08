"""Wire format of ``rmw_zenoh``: keys of topics, tokens of the graph, identities of publishers, attachments of messages.

Sources: ``docs/design.md`` and ``rmw_zenoh_cpp/src/detail`` of https://github.com/ros2/rmw_zenoh. Releases since
Humble 0.1.2, Jazzy 0.2.4 and Rolling 0.6.0 use this form of the attachment.
"""

import struct
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import xxhash

from monstertruck_runtime.errors import InputError
from monstertruckd.ros2.interfaces import type_hash, wire_name

LIVELINESS: Final = "@ros2_lv"
"""First chunk of all tokens; wildcards do not match it."""
NO_HASH: Final = "TypeHashNotSupported"
"""Replaces every hash in Humble, which has none."""
GID_SIZE: Final = 16

_ATTACHMENT: Final = struct.Struct(f"<qqB{GID_SIZE}s")


class EntityKind(StrEnum):
    """Entity of a token."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class RosQos:
    """Quality of service, as far as ``rmw_zenoh`` distinguishes it; all combinations are compatible."""

    depth: int = 10
    """Number of messages kept for late subscribers, or while a subscriber is busy."""
    reliable: bool = True
    latched: bool = False
    """Transient local: late subscribers receive the latest ``depth`` messages."""

    @property
    def text(self) -> str:
        """Return the form in a token, where defaults of ``rmw_zenoh`` are empty."""
        depth = "" if self.depth == 42 else str(self.depth)  # 42: the default depth
        return f"{'' if self.reliable else 2}:{1 if self.latched else ''}:,{depth}:,:,:,,"


RELIABLE: Final = RosQos()
SENSOR: Final = RosQos(depth=5, reliable=False)
LATCHED: Final = RosQos(depth=1, latched=True)


def dds_name(interface: str) -> str:
    """Return the name of an interface in keys: ``pkg::msg::dds_::Name_``."""
    package, group, name = wire_name(interface).split("/")
    return f"{package}::{group}::dds_::{name}_"


def data_key(domain: int, name: str, interface: str, *, hashed: bool = True) -> str:
    """Return the key of a topic or service.

    Args:
        domain: ``ROS_DOMAIN_ID``.
        name: fully qualified, such as ``/truck1/scan``.
        interface: interface of the topic or service, from the interface file.
        hashed: False for Humble.
    """
    return f"{domain}/{name.strip('/')}/{dds_name(interface)}/{type_hash(interface) if hashed else NO_HASH}"


def mangled(text: str) -> str:
    """Encode a name as one chunk of a token."""
    return text.replace("/", "%") or "%"


@dataclass(frozen=True, slots=True)
class RosEntity:
    """A node, or a publisher, subscription, service or client of one."""

    kind: EntityKind
    namespace: str
    """``/`` or ``/truck1``."""
    node: str
    topic: str = ""
    interface: str = ""
    """``pkg::msg::dds_::Name_``."""
    owner: str = ""
    """Session and number of the node; distinguishes nodes with the same name."""

    @property
    def qualified_node(self) -> str:
        """Qualified name, such as ``/truck1/teleop``."""
        return f"{self.namespace.rstrip('/')}/{self.node}"


def token_key(
    domain: int, session: str, numbers: tuple[int, int], entity: RosEntity, type_and_qos: tuple[str, str] = ("", "")
) -> str:
    """Return the key of a liveliness token.

    Args:
        domain: ``ROS_DOMAIN_ID``.
        session: id of the Zenoh session.
        numbers: numbers of the node and of the entity, unique in the session; equal for a node.
        entity: node, publisher, subscriber, service or client of the token.
        type_and_qos: type hash and quality of service; unused for a node.
    """
    node, own = numbers
    chunks = [LIVELINESS, str(domain), session, str(node), str(own), entity.kind.value, "%"]
    chunks += [mangled("" if entity.namespace == "/" else entity.namespace), mangled(entity.node)]
    if entity.kind is not EntityKind.NODE:
        chunks += [mangled(entity.topic), mangled(entity.interface), *type_and_qos]
    return "/".join(chunks)


def parsed_token(key: str) -> RosEntity:
    """Parse the entity of a token; newer releases may append chunks.

    Raises:
        InputError: the key is not a token.
    """
    chunks = key.split("/")
    try:
        kind = EntityKind(chunks[5])
        namespace, node = (chunk.replace("%", "/") for chunk in chunks[7:9])  # chunks of a node's token
        owner = f"{chunks[2]}/{chunks[3]}"
        if kind is EntityKind.NODE:
            return RosEntity(kind, namespace, node, owner=owner)
        return RosEntity(kind, namespace, node, chunks[9].replace("%", "/"), chunks[10], owner)
    except (IndexError, ValueError):
        raise InputError(f"{key!r}: expected a token of rmw_zenoh") from None


def gid_of(token: str) -> bytes:
    """Return the GID of a token's publisher, as in its messages: XXH3-128, low half first, little endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_SIZE, "little")


@dataclass(frozen=True, slots=True)
class Attachment:
    """Attachment of every message."""

    sequence: int
    """Sequence number of the publisher, starting at 1; a reply repeats the number of its request."""
    stamp: int
    """Send time (ns since 1970)."""
    gid: bytes
    """GID of the publisher; a reply has the GID of its client."""

    def packed(self) -> bytes:
        """Return the bytes of the attachment."""
        return _ATTACHMENT.pack(self.sequence, self.stamp, GID_SIZE, self.gid)

    @classmethod
    def parse(cls, data: bytes | None) -> "Attachment":
        """Parse an attachment.

        Raises:
            InputError: it is missing or malformed.
        """
        if data is None or len(data) != _ATTACHMENT.size:
            raise InputError(f"attachment of {0 if data is None else len(data)} bytes: expected {_ATTACHMENT.size}")
        sequence, stamp, size, gid = _ATTACHMENT.unpack(data)
        if size != GID_SIZE:
            raise InputError(f"attachment with a gid of {size} bytes: expected {GID_SIZE}")
        return cls(sequence, stamp, gid)
