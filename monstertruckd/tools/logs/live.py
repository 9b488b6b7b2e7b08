"""Draws a running robot in the rerun viewer, like its log. Started by ``live_process``.

    python -m monstertruckd.tools.logs.live ROBOT ENDPOINT VIEWER

It ends when its standard input does.
"""

import os
import sys
import threading
from contextlib import ExitStack, suppress
from typing import Any, Final

import rerun as rr

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic
from monstertruckd.tools.logs.report.signals import FIGURES
from monstertruckd.tools.logs.rerun_view import APPLICATION, Scene, blueprint

DRAWN: Final[tuple[Topic[Any], ...]] = (
    t.SCAN, t.TRANSFORMS, t.MAP, t.PATH, t.POSE, t.CAMERA, t.GATE, t.HEALTH, t.EVENT, t.STOP, t.LOG,
)  # fmt: skip


async def follow(robot: str, endpoint: str, clock: Clock, stream: rr.RecordingStream) -> None:
    """Draw a robot's messages into a recording until cancelled."""
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    drawn: list[Topic[Any]] = [*DRAWN, *(curve.topic for figure in FIGURES for curve in figure.curves)]
    topics = {topic.name: topic for topic in drawn}
    scene = Scene(stream, clock.real_offset())
    laid_out: set[str] = set()
    retry = 1.0  # interval between connection attempts to the robot, and timeout of its answer (s)
    while True:
        with suppress(TruckError):
            async with TruckClient(robot, endpoint, clock=clock, timeout=retry) as client:
                with ExitStack() as stack:
                    waiting = 200  # maximum number of waiting messages of a topic
                    boxes = [
                        (topic, stack.enter_context(client.subscribe(topic, fifo(waiting))))
                        for topic in topics.values()
                    ]
                    await _box(scene, client)
                    while True:
                        take(scene, boxes)
                        if scene.entities != laid_out:
                            laid_out = set(scene.entities)
                            stream.send_blueprint(blueprint(laid_out))
                        await clock.sleep(0.1)  # seconds between two checks for messages
        await clock.sleep(retry)


def take(scene: Scene, boxes: list[tuple[Topic[Any], Mailbox[Any]]]) -> None:
    """Draw all waiting messages in the order of their stamps."""
    waiting: list[tuple[Message, str]] = [(message, topic.name) for topic, box in boxes for message in box.drain()]
    for message, topic in sorted(waiting, key=lambda row: row[0].received):
        scene.take(topic, message.received, message)
    scene.flush()


def main() -> None:
    """Draw until standard input ends; wait for a robot that is absent."""
    robot, endpoint, viewer = sys.argv[1:]
    # Drawing blocks while the viewer accepts nothing, so a thread has to detect the end of the input.
    threading.Thread(target=_end_with_input, daemon=True).start()
    stream = rr.RecordingStream(APPLICATION)
    stream.connect_grpc(viewer)
    run_wall(lambda clock: follow(robot, endpoint, clock, stream))


def _end_with_input() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


async def _box(scene: Scene, client: TruckClient) -> None:
    with suppress(TruckError):
        scene.box((await client.call("config")).get("geometry", {}))


if __name__ == "__main__":
    main()
