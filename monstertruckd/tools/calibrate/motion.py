"""Moves of a wizard: drive requests sent through the safety gate, like those of any operator."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from typing import Any, Final

from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.presence import GONE
from monstertruck_schemas import topics
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.reasons import Reason, in_words
from monstertruck_schemas.sensor import Attitude, DriveFeedback, SteeringFeedback
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep

REQUEST_PERIOD: Final = 0.05
"""Request period (s)."""
ANSWERED: Final = 3.0
"""Time limit for an answer of the gate (s)."""
RESTING: Final = 5.0
"""Time limit for coming to rest (s)."""
LATE: Final = (
    "drive requests arrived too late: stop other programs that load this computer or the link to the "
    "robot, or run the command on the robot's computer; repeat it (nothing was saved)"
)
"""Advice for an expired lease."""
SILENT: Final = (
    "a device was silent (`monstertruckd status` names it), or the robot's computer is overloaded: stop "
    "other programs on it and repeat the command (nothing was saved)"
)
"""Advice for late measurements or ticks."""
ADVICE: Final = {
    Reason.LEASE_EXPIRED: LATE,
    Reason.SCAN_STALE: SILENT,
    Reason.DRIVE_STALE: SILENT,
    Reason.STEERING_STALE: SILENT,
    Reason.ATTITUDE_STALE: SILENT,
    Reason.TICK_STALLED: SILENT,
}
"""Advice by transient stop reason; the mover repeats a move stopped for one of these reasons."""


class Mover:
    """Executes moves.

    Args:
        truck: link to the truck.
        clock: time source.
        chassis: drivetrain data, to compute distances.
    """

    def __init__(self, truck: TruckClient, clock: Clock, chassis: Chassis) -> None:
        self._truck = truck
        self._clock = clock
        self._drivetrain = chassis.drivetrain

    async def move(
        self, move: MoveStep, report: Callable[[MoveRecord, float], None], say: Callable[[str], None] = lambda _: None
    ) -> MoveRecord:
        """Drive ``move`` and return its record; ``report`` gets the record so far and the distance (m).

        The truck is always stopped and disarmed at the end. After a transient stop, such as a late request, the mover
        notifies the operator through ``say``, drives back to the start of the move and repeats it, at most twice.

        Raises:
            RequestRefusedError: the gate refused, stopped or held the truck; carries the gate's reason.
            NoAnswerError: the truck does not move although the gate allows it, or sends no feedback.
        """
        unmoved = 0.01  # maximum distance from the start at which a move counts as not begun (m)
        depth = 4096
        with (
            ExitStack() as besides,
            self._truck.subscribe(topics.DRIVE, fifo(depth)) as drive,
            self._truck.subscribe(topics.STEERING, fifo(depth)) as steering,
            self._truck.subscribe(topics.COMPASS, fifo(depth)) as attitude,
            self._truck.subscribe(topics.GATE, fifo(depth)) as gate,
            self._truck.subscribe(topics.CMD_STEERING, fifo(depth)) as steering_commands,
            self._truck.subscribe(topics.CMD_DRIVE, fifo(depth)) as drive_commands,
        ):
            feeds = drive, steering, attitude, gate, steering_commands, drive_commands
            also = {t.name: besides.enter_context(self._truck.subscribe(t, fifo(depth))) for t in move.also}
            for left in (2, 1, 0):  # maximum number of restarts after a transient stop
                run = _Run(self._truck, self._clock, feeds, also)
                try:
                    await self._once(run, move, report)
                    break
                except RequestRefusedError as error:
                    covered = await run.coasted(self._drivetrain) if left and error.refusal in ADVICE else None
                    if covered is None or (move.marked and covered > unmoved):
                        raise
                    say(f"{move.name}: {error.refusal.text}; returning to the start for another attempt")
                if covered > unmoved:
                    await self._once(_Run(self._truck, self._clock, feeds, also), move.back(covered), report)
            return run.track

    async def _once(self, run: "_Run", move: MoveStep, report: Callable[[MoveRecord, float], None]) -> None:
        async with self._armed(run):
            steering = 1.0  # time for the wheels to turn while the truck stands (s)
            if move.approach:
                await run.hold(0.0, move.approach, move.approach, steering)
            await run.hold(0.0, move.front, move.rear, steering)
            run.begin()
            await run.hold(0.0, move.front, move.rear, move.rest)
            await self._drive(run, move, report)
            await run.rest(move.front, move.rear)
            await run.hold(0.0, move.front, move.rear, move.rest)

    async def _drive(self, run: "_Run", move: MoveStep, report: Callable[[MoveRecord, float], None]) -> None:
        run.track.left = run.robot_time
        distance, since = 0.0, self._clock.now()
        began = since
        stuck = 3.0  # maximum time without progress in a move (s)
        while True:
            side = move.side((self._clock.now() - began) / SECOND)
            await run.hold(move.speed, side * move.front, side * move.rear, REQUEST_PERIOD)
            new = abs(run.track.distance(self._drivetrain))
            report(run.track, new)
            if new >= move.metres or (move.done is not None and move.done(run.track)):
                return
            if new - distance > 0.01:  # minimum progress (m)
                distance, since = new, self._clock.now()
            elif self._clock.now() - since > stuck * SECOND:
                text = f"{move.name}: no progress for {stuck:g} s ({run.state.why if run.state else 'silent'})"
                held = run.state is not None and run.state.reasons
                raise RequestRefusedError(held[0], text) if held else NoAnswerError(text)

    @asynccontextmanager
    async def _armed(self, run: "_Run") -> AsyncIterator[None]:
        """Keep the truck armed inside the context; stop and disarm it afterwards, also after errors."""
        await run.free()
        try:
            await run.arm()
            yield
        finally:
            # Without a link the gate stops the truck: the lease of the last request expires.
            with suppress(TruckError):
                await self._truck.disarm()


class _Run:
    """One move: renews the lease, collects feedback and follows the gate's state."""

    def __init__(
        self,
        truck: TruckClient,
        clock: Clock,
        feeds: tuple[
            Mailbox[DriveFeedback],
            Mailbox[SteeringFeedback],
            Mailbox[Attitude],
            Mailbox[GateState],
            Mailbox[SteeringCommand],
            Mailbox[DriveCommand],
        ],
        also: dict[str, Mailbox[Any]],
    ) -> None:
        self.track = MoveRecord()
        self.state: GateState | None = None
        self._heard = clock.now()
        """Arrival time of the latest gate state (ns)."""
        self._truck = truck
        self._clock = clock
        self._feeds = feeds
        self._also = also

    @property
    def robot_time(self) -> int:
        """Latest stamp received from the robot (ns); the robot's clock differs from this computer's."""
        stamps = [0 if self.state is None else self.state.stamp, *(reading.stamp for reading in self.track.drive[-1:])]
        return max(stamps)

    def begin(self) -> None:
        """Discard the readings collected so far."""
        self.track = MoveRecord()

    async def free(self) -> None:
        """Check that no other operator uses the truck.

        Raises:
            RequestRefusedError: the truck is armed.
            NoAnswerError: the gate publishes no state.
        """
        end = self._clock.now() + round(ANSWERED * SECOND)
        while self.state is None:
            if self._clock.now() > end:
                raise NoAnswerError(f"no state of the gate within {ANSWERED:g} s")
            await self._clock.sleep(REQUEST_PERIOD)
            self._take()
        if self.state.mode.active:
            holder = f", {self.state.holder} drives" if self.state.holder else ""
            raise RequestRefusedError(Reason.BUSY, f"the robot is already armed{holder}: disarm it first")

    async def arm(self) -> None:
        """Request standstill briefly, then arm without planners, so that nothing else moves the truck.

        Raises:
            RequestRefusedError: the gate refused.
            NoAnswerError: the gate did not answer.
        """
        end = self._clock.now() + round(ANSWERED * SECOND)
        requests = 0
        refusal: TruckError | None = None
        arming: asyncio.Task[TruckError | None] | None = None
        try:
            while not self._driving():
                if self._clock.now() > end:
                    raise refusal or NoAnswerError(f"the gate did not arm the robot within {ANSWERED:g} s")
                await self._request(0.0, 0.0, 0.0)
                requests += 1
                if arming is not None and arming.done():
                    refusal, arming = arming.result(), None
                # 3: standstill requests before the arm order
                elif arming is None and requests >= 3 and self.state and not self.state.mode.active:
                    arming = asyncio.create_task(self._try_to_arm())
                await self._clock.sleep(REQUEST_PERIOD)
                self._take()
        finally:
            if arming is not None:
                arming.cancel()

    async def _try_to_arm(self) -> TruckError | None:
        """Arm the truck; return the error, or None on success."""
        try:
            await self._truck.arm(hold=True, calibrates=True)
        except TruckError as error:
            return error
        return None

    def _driving(self) -> bool:
        state = self.state
        return state is not None and state.mode is GateMode.DRIVING and state.holder == self._truck.source

    async def _request(self, speed: float, front: float, rear: float) -> None:
        """Request a motion, with a lease of several request periods."""
        await self._truck.drive(speed, front, rear, 10 * REQUEST_PERIOD)  # the gate may grant less

    async def hold(self, speed: float, front: float, rear: float, seconds: float) -> None:
        """Request one motion for ``seconds``.

        Raises:
            RequestRefusedError: the gate stopped the truck, or another operator drives.
            NoAnswerError: the robot has been silent for ``GONE`` s.
        """
        end = self._clock.now() + round(seconds * SECOND)
        while self._clock.now() < end:
            await self._request(speed, front, rear)
            await self._clock.sleep(min(REQUEST_PERIOD, (end - self._clock.now()) / SECOND))
            self._take()
            self._check()

    async def rest(self, front: float, rear: float) -> None:
        """Stop and wait until the truck is at rest."""
        end = self._clock.now() + round(RESTING * SECOND)
        still = -1
        while self._clock.now() < end:
            await self.hold(0.0, front, rear, REQUEST_PERIOD)
            if not self.track.drive:
                continue
            newest = self.track.drive[-1]
            moved = [r for r in self.track.drive if _moved(r, newest)]
            if moved and _rested(moved[-1], newest):
                still = newest.stamp
                break
        if still < 0:
            raise NoAnswerError(f"the drive does not come to rest within {RESTING:g} s")
        self.track.arrived = still

    async def coasted(self, drivetrain: DriveTrain) -> float | None:
        """Wait until a stopped truck is at rest and the reason for the stop has cleared.

        Returns:
            Distance travelled (m); None if the truck does not come to rest or the reason does not clear.
        """
        end = self._clock.now() + round(RESTING * SECOND)
        since: DriveFeedback | None = None
        while self._clock.now() < end:
            await self._clock.sleep(REQUEST_PERIOD)
            self._take()
            newest = self.track.drive[-1] if self.track.drive else None
            if since is None or newest is None or _moved(since, newest):
                since = newest
            elif _rested(since, newest) and not self._lasting():
                return abs(self.track.distance(drivetrain))
        return None

    def _lasting(self) -> bool:
        """Whether the gate still reports a transient stop reason."""
        return self.state is None or any(reason in ADVICE for reason in self.state.reasons)

    def _take(self) -> None:
        drive, steering, attitude, gate, steering_commands, drive_commands = self._feeds
        self.track.steering_commands += steering_commands.drain()
        self.track.drive_commands += drive_commands.drain()
        self.track.drive += drive.drain()
        self.track.steering += [reading for reading in steering.drain() if reading.trusted]
        self.track.attitude += [reading for reading in attitude.drain() if not reading.heading_disturbed]
        for name, mailbox in self._also.items():
            self.track.others.setdefault(name, []).extend(mailbox.drain())
        if states := gate.drain():
            self.state, self._heard = states[-1], self._clock.now()

    def _check(self) -> None:
        state = self.state
        if self._clock.now() - self._heard > GONE * SECOND:
            raise NoAnswerError(f"the robot has been silent for {GONE:g} s; it stops by itself, and nothing was saved")
        if state is None or self._driving():
            return
        reasons = state.hindrances
        if not reasons and state.mode is GateMode.DRIVING:
            raise RequestRefusedError(Reason.BUSY, f"{state.holder} drives the robot")
        if not reasons and state.mode.active:  # still armed, but no longer controlled by this wizard
            reasons = (Reason.LEASE_EXPIRED,)
        text = in_words(reasons) or f"the robot is {state.mode}"
        advice = "".join(f"; {text}" for text in dict.fromkeys(ADVICE[r] for r in reasons if r in ADVICE))
        raise RequestRefusedError(reasons[0] if reasons else Reason.DISARMED, f"stopped by the gate: {text}{advice}")


def _moved(since: DriveFeedback, newest: DriveFeedback) -> bool:
    """Return whether the motor has turned further than an encoder that alternates between two counts would show."""
    return abs(newest.position - since.position) > 0.1


def _rested(since: DriveFeedback, newest: DriveFeedback) -> bool:
    """Return whether a drive that has not moved since a reading is at rest."""
    return newest.stamp - since.stamp > SECOND // 2
