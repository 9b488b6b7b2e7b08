"""The robot for notebooks and scripts without asyncio: every call waits for its outcome.

with Truck("truck", "tcp/192.168.1.7:7447") as truck:
    truck.goto(1, 2, 0, arm=True)
"""

import asyncio
import threading
import weakref
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import suppress
from functools import partial
from typing import Any, Final, Self, TypeVar

import uvloop

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock, WallClock
from monstertruck_runtime.drives import Arrival, drive_to, follow
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas.base import Message
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import Topic

M = TypeVar("M", bound=Message)
T = TypeVar("T")

WAIT: Final = 5.0
"""Default timeout for a message (s)."""


class Truck:
    """Session with one robot, over a ``TruckClient`` on an event loop in a separate thread.

    A context manager. Without ``with`` it opens at the first call, and closes with ``close()``, when it is
    garbage-collected, or at the end of the program. Calls may come from any thread. Closing makes pending calls of
    other threads raise ``RuntimeError``. A call in a forked process also raises it: open another session there. Ctrl-C
    during ``goto`` cancels the goal.

    Args:
        robot: name in the keys ``mt/<robot>/...``; None: ``truck``.
        endpoint: address of the robot; see ``TruckClient``.
        source: this program's name in requests; see ``TruckClient``.
        timeout: timeout for the link and for answers, s.
    """

    def __init__(
        self,
        robot: str | None = None,
        endpoint: str | None = None,
        *,
        source: str | None = None,
        timeout: float = 6.0,
    ) -> None:
        self._clock: Clock = WallClock()
        self._make = partial(TruckClient, robot, endpoint, source=source, clock=self._clock, timeout=timeout)
        self._loop: _LoopThread | None = None
        self._lock = threading.Lock()
        self._finalizer: weakref.finalize[..., Truck] | None = None

    def __enter__(self) -> Self:
        """Connect. Raises the errors of ``TruckClient``."""
        self._opened()
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """End the session; the next call opens a new one."""
        with self._lock:
            finalizer, self._finalizer, self._loop = self._finalizer, None, None
        if finalizer is not None:
            finalizer()

    # Messages of the robot

    def get(self, topic: Topic[M], timeout: float = WAIT) -> M:
        """Latest message of ``topic`` if it is retained, otherwise the next one.

        Raises:
            NoAnswerError: no message within ``timeout`` s.
        """
        with self.stream(topic, timeout) as messages:
            return next(messages)

    def stream(self, topic: Topic[M], timeout: float = WAIT, depth: int = 256) -> "MessageStream[M]":
        """Iterator over messages of ``topic``; up to ``depth`` wait, then the oldest is dropped.

        Iteration raises ``NoAnswerError`` if no message arrives within ``timeout`` s.
        """
        return MessageStream(self, topic, timeout, depth)

    def call(self, rpc: str, payload: dict[str, Any] | None = None, timeout: float | None = None) -> dict[str, Any]:
        """Call ``rpc`` on the robot with a JSON object. Raises the errors of ``TruckClient.call``."""
        return self._do(lambda client: client.call(rpc, payload, timeout))

    def alive(self) -> bool:
        """Whether the robot's daemon is running."""
        return self._do(lambda client: client.alive())

    # Orders

    def arm(self, *, hold: bool = False) -> GateState:
        """Allow driving, with ``hold`` except by planners. All orders raise the errors of ``TruckClient.order``."""
        return self._do(lambda client: client.arm(hold=hold))

    def disarm(self) -> GateState:
        """Stop and forbid driving."""
        return self._do(lambda client: client.disarm())

    def stop(self) -> GateState:
        """Stop driving by the ordinary ramp."""
        return self._do(lambda client: client.stop())

    def estop(self) -> GateState:
        """Emergency stop, latched."""
        return self._do(lambda client: client.estop())

    def reset(self) -> GateState:
        """Clear the emergency stop."""
        return self._do(lambda client: client.reset())

    # Driving

    def goto(
        self, x: float, y: float, yaw: float = 0.0, *, via: Sequence[tuple[float, ...]] = (), arm: bool = False
    ) -> Arrival:
        """Drive to a pose in the map and wait for the end.

        Args:
            x: position, m.
            y: position, m.
            yaw: heading, rad.
            via: waypoints, x, y and optionally yaw.
            arm: whether to arm the truck, which then starts to drive at once; otherwise another client has to arm it.

        Raises:
            RequestRefusedError: the goal or the arming was refused, or the robot abandoned the goal; carries the
                reason.
            NoAnswerError: the robot does not answer.
        """
        return _reached(self._do(lambda client: drive_to(client, self._clock, (x, y, yaw), via, arm=arm)))

    def cancel(self) -> None:
        """Cancel the goal."""
        self._do(lambda client: client.goal_control(GoalOrder.CANCEL))

    def follow(self, path: Path, *, arm: bool = False) -> Arrival:
        """Drive along a path and wait for the end. Raises the errors of ``goto``."""
        return _reached(self._do(lambda client: follow(client, self._clock, path, arm=arm)))

    def drive(self, speed: float, front: float, rear: float = 0.0, lease: float = 0.25) -> None:
        """Request a speed (m/s) and axle angles (rad) for ``lease`` s; the request is not repeated."""
        self._do(lambda client: client.drive(speed, front, rear, lease))

    def drive_twist(self, vx: float, vy: float = 0.0, wz: float = 0.0, lease: float = 0.25) -> None:
        """Request a velocity of the base, m/s and rad/s, for ``lease`` s; the request is not repeated."""
        self._do(lambda client: client.drive_twist(vx, vy, wz, lease))

    def _do(self, work: Callable[[TruckClient], Coroutine[Any, Any, T]]) -> T:
        return self._opened().do(work)

    def _opened(self) -> "_LoopThread":
        with self._lock:
            if self._loop is None:
                self._loop = _LoopThread(self._make)
                # It must not refer to this object, which could then never be collected.
                self._finalizer = weakref.finalize(self, self._loop.close)
            return self._loop


class MessageStream(Iterator[M]):
    """Messages of one topic; ends with its ``with`` block, or when it is garbage-collected."""

    def __init__(self, truck: Truck, topic: Topic[M], timeout: float, depth: int) -> None:
        self._truck = truck  # which would close itself if no other reference exists
        self._loop = truck._opened()  # noqa: SLF001 - one module
        self._topic = topic
        self._timeout = timeout

        async def subscribe(client: TruckClient) -> Any:
            return client.subscribe(topic, latest() if depth == 1 else fifo(depth))

        self._box = self._loop.do(subscribe)
        self._finalizer = weakref.finalize(self, self._loop.later, self._box.close)

    def __next__(self) -> M:
        """Return the next message.

        Raises:
            NoAnswerError: no message in time.
        """

        async def following(_: TruckClient) -> M | None:
            message: M | None = await self._box.next_within(self._timeout)
            return message

        message = self._loop.do(following)
        if message is None:
            raise NoAnswerError(f"no message of {self._topic.name} within {self._timeout:g} s")
        return message

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the subscription."""
        self._finalizer()


class _LoopThread:
    """Event loop in a thread, with a client that is open while it runs.

    Raises:
        TruckError: the client could not be opened.
    """

    def __init__(self, make: Callable[[], TruckClient]) -> None:
        self._client = make()
        self._loop = uvloop.new_event_loop()
        self._ending = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="truck", daemon=True)
        self._thread.start()
        try:
            self._submit(self._client.__aenter__())
        except BaseException:
            self._end()
            raise

    def do(self, work: Callable[[TruckClient], Coroutine[Any, Any, T]]) -> T:
        """Run a coroutine on the thread's loop and wait for its result; an interrupt cancels it."""
        return self._submit(work(self._client))

    def later(self, function: Callable[[], object]) -> None:
        """Call ``function`` on the thread's loop without waiting; no effect after the loop has ended."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function)

    def close(self) -> None:
        """Close the client and end the thread."""
        if threading.current_thread() is self._thread:  # the garbage collector may run in any thread
            self._last = self._loop.create_task(self._close_here())
        elif self._thread.is_alive():
            self._submit(self._client.__aexit__(None, None, None))
            self._end()

    async def _close_here(self) -> None:
        await self._client.__aexit__(None, None, None)
        self._ending.set()

    def _submit(self, work: Coroutine[Any, Any, T]) -> T:
        if not self._thread.is_alive():
            work.close()
            raise RuntimeError("the session was closed, or this process was forked from the one that opened it")
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except CancelledError:
            raise RuntimeError("the session was closed meanwhile") from None
        except BaseException:
            if not future.done():
                # The coroutine withdraws its request and ends before the interrupt is passed on.
                future.cancel()
                self._settle()
            raise

    def _settle(self) -> None:
        async def others() -> None:
            tasks = asyncio.all_tasks() - {asyncio.current_task()}
            await asyncio.wait(tasks, timeout=WAIT) if tasks else None

        asyncio.run_coroutine_threadsafe(others(), self._loop).result()

    async def _give_up(self) -> None:
        """Cancel the pending calls of other threads."""
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(WAIT)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._ending.wait())
            self._loop.run_until_complete(self._give_up())
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
        finally:
            self._loop.close()


def _reached(arrival: Arrival) -> Arrival:
    """Return the arrival if the robot arrived.

    Raises:
        RequestRefusedError: the drive ended without arrival.
    """
    if arrival.reason is not Reason.GOAL_REACHED:
        raise RequestRefusedError(arrival.reason, f"{arrival.reason.text}: {arrival.text}")
    return arrival
