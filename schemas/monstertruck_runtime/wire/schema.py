"""Protobuf descriptors of the well-known messages with our own fields added, for logs and queries."""

from importlib import import_module

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet

from monstertruck_runtime.wire.layouts import FIRST_OWN_FIELD
from monstertruck_runtime.wire.protobuf import Field, Layout


def descriptor_set(layout: Layout) -> bytes:
    """Serialized ``FileDescriptorSet`` of ``layout``, dependencies first.

    Standard fields come from the published schemas, ours from the layout.
    """
    short = layout.name.rpartition(".")[2]
    root: FileDescriptor = import_module(f"foxglove_schemas_protobuf.{short}_pb2").DESCRIPTOR
    files: dict[str, FileDescriptorProto] = {}
    _collect(root, files)
    (message,) = (m for m in files[root.name].message_type if m.name == short)
    message.field.extend(_describe(row) for row in layout.fields if row.number >= FIRST_OWN_FIELD)
    return FileDescriptorSet(file=files.values()).SerializeToString(deterministic=True)


def _collect(file: FileDescriptor, files: dict[str, FileDescriptorProto]) -> None:
    for dependency in file.dependencies:
        _collect(dependency, files)
    if file.name not in files:
        proto = FileDescriptorProto()
        file.CopyToProto(proto)
        files[file.name] = proto


def _describe(row: Field) -> FieldDescriptorProto:
    proto = FieldDescriptorProto(name=row.name, number=row.number, json_name=row.name)
    proto.type = FieldDescriptorProto.Type.ValueType(row.kind.descriptor_type)
    many = row.repeated or row.kind.packed
    proto.label = FieldDescriptorProto.LABEL_REPEATED if many else FieldDescriptorProto.LABEL_OPTIONAL
    return proto
