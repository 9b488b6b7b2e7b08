"""Topics as MCAP channels: the one place that decides how a topic is written to a log."""

from typing import Any

from mcap.writer import Writer

from monstertruck_runtime import wire
from monstertruck_schemas.topics import Topic


class Channels:
    """Registers each topic with its schema when it is first asked for.

    Args:
        writer: of the file, started.
    """

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def of(self, topic: Topic[Any]) -> int:
        """Number of the topic's channel."""
        return self._channels.get(topic.name) or self._register(topic)

    def _register(self, topic: Topic[Any]) -> int:
        schema = wire.schema(topic)
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        channel = self._writer.register_channel(
            topic.name, schema.message_encoding, self._schemas[schema.name], {"encoding": wire.encoding(topic)}
        )
        self._channels[topic.name] = channel
        return channel
