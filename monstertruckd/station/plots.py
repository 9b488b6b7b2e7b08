"""Numbers in messages over time, for the plots on the page: their names, and their values at every tick."""

import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from functools import cache
from typing import Annotated, Any, Final, Union, get_args, get_origin

from pydantic import BaseModel

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message, field_docs
from monstertruck_schemas.topics import Topic
from monstertruckd.station import frames
from monstertruckd.station.viewer import Viewer

UNIONS: Final = (Union, types.UnionType)
HEADER: Final = frozenset(Message.model_fields)
"""Fields that are not plotted: stamp, sequence and the like."""


@cache
def numbers() -> Mapping[str, str]:
    """Return the meaning of every number by its name ``topic:field.field``; "" if it has none.

    Numbers in lists are omitted because the length of a list varies.
    """
    return {
        f"{topic.name}:{path}": meaning
        for topic in topics.TOPICS
        if not topic.inward
        for path, meaning in _numbers_of(topic.model, "")
    }


def _numbers_of(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str]]:
    docs = field_docs(model)
    for name, field in model.model_fields.items():
        if not prefix and name in HEADER:
            continue
        kind, meaning = _plain_type(field.annotation), " ".join(docs.get(name, "").split())
        if kind in (float, int, bool):
            yield f"{prefix}{name}", meaning
        elif isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from _numbers_of(kind, f"{prefix}{name}.")


def _plain_type(annotation: Any) -> Any:
    """Return the type without constraints and without None."""
    if get_origin(annotation) is Annotated:
        return _plain_type(get_args(annotation)[0])
    if get_origin(annotation) in UNIONS:
        (kind, *others) = (each for each in get_args(annotation) if each is not type(None))
        return None if others else _plain_type(kind)
    return annotation


def require_numbers(names: Iterable[str]) -> None:
    """Check the names requested by a browser.

    Raises:
        InputError: a name is not among ``numbers``.
    """
    for name in names:
        if name not in numbers():
            raise InputError(f"{name}: expected a numeric field of a topic, such as state/gate:speed_limit")


def value_in(message: Message, path: str) -> float | None:
    """Return the number at ``path``; None if it is absent."""
    value: Any = message
    for name in path.split("."):
        value = getattr(value, name, None)
    return None if value is None else round(float(value), 6)


class Subscriptions:
    """Latest messages of the plotted topics; a topic is subscribed to when it is first used.

    Args:
        subscribe: opens a mailbox for a topic.
        stack: closes all mailboxes.
    """

    def __init__(self, subscribe: Callable[[Topic[Any], Any], Mailbox[Any]], stack: ExitStack) -> None:
        self._subscribe, self._stack = subscribe, stack
        self._boxes: dict[str, Mailbox[Any]] = {}

    def newest(self, topic: str) -> Message | None:
        """Return the latest message of a topic."""
        if topic not in self._boxes:
            self._boxes[topic] = self._stack.enter_context(self._subscribe(topics.BY_NAME[topic], latest()))
        message: Message | None = self._boxes[topic].latest
        return message


class Sampler:
    """Sends browsers the values that they plot.

    Args:
        newest: function that returns the latest message of a topic.
    """

    def __init__(self, newest: Callable[[str], Message | None]) -> None:
        self._newest = newest
        self._taken: dict[str, Message] = {}

    def sample(self, viewers: Iterable[Viewer]) -> None:
        """Send the values since the last call: one for each plotted number, None if there is no new message."""
        plotting = [viewer for viewer in viewers if viewer.plotted]
        wanted = {name.partition(":")[0] for viewer in plotting for name in viewer.plotted}
        found = ((topic, self._newest(topic)) for topic in sorted(wanted))
        new = {topic: of for topic, of in found if of is not None and of is not self._taken.get(topic)}
        self._taken = {topic: of for topic, of in self._taken.items() if topic in wanted} | new
        for viewer in plotting:
            rows = [(new.get(topic), path) for topic, _, path in (name.partition(":") for name in viewer.plotted)]
            stamps = [of.stamp for of, _ in rows if of is not None]
            if stamps:
                values = [None if of is None else value_in(of, path) for of, path in rows]
                viewer.send(frames.text("samples", set=viewer.plot_set, at=max(stamps) / SECOND, values=values))
