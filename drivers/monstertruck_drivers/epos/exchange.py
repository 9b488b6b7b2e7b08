"""EPOS byte handshake over a link: one exchange at a time, with timeouts and recovery."""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.objects import ObjectEntry, abort_text
from monstertruck_drivers.epos.protocol import (
    ANSWER,
    READY,
    REFUSED,
    Frame,
    FrameError,
    Opcode,
    body_size,
    decode_body,
    decode_segment,
    error_of,
    join,
    read_request,
    segment_request,
    segmented_read_request,
    write_request,
)
from monstertruck_drivers.link import Link
from monstertruck_drivers.transaction import Steps, Transaction, WaitFor
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceMismatchError, DeviceTimeoutError, ProtocolError, WrongDeviceError

T = TypeVar("T")

QUIET = 0.55
"""Silence that reliably makes a controller with factory settings drop an incomplete frame (s)."""
QUICK_ANSWER = 0.05
"""Maximum duration of recent exchanges on a fast line (s); on such a line a missing byte is lost, not late."""
RECENT = 32
"""Number of latest exchanges whose median duration is judged."""
ATTEMPTS = 3
"""Number of attempts at an exchange outside the schedule."""
BRIEF_SILENCES = 2
"""Maximum consecutive failures that need a brief silence only. The second failure most likely has the same cause as the
first, as the request is repeated within some 130 ms; a controller that lost the time-out set by the host needs a long
silence."""

_ANSWER_LENGTHS: dict[int, frozenset[int]] = {Opcode.READ: frozenset((1, 3)), Opcode.WRITE: frozenset((1,))}


class ObjectError(ProtocolError):
    """The controller answered with a communication error.

    Args:
        subject: name of the request.
        code: 32-bit error code.
    """

    def __init__(self, subject: str, code: int) -> None:
        super().__init__(f"{subject}: {abort_text(code)}")
        self.code = code


class Exchanger:
    """Object access over one link.

    A started exchange is completed even if its caller is cancelled, so that the controller listens to the next frame
    (most likely a stop); ``finish`` waits for its end.

    Args:
        link: open link to the controller.
        clock: time.
        node: node id.
        quiet_until: time until which an earlier link requires silence (ns).
    """

    def __init__(self, link: Link, clock: Clock, node: int, quiet_until: int = 0) -> None:
        self._link = link
        self._clock = clock
        self._node = node
        self._flight: Transaction[Any] | None = None
        self._hurried = False
        """Task that waits for the end of the exchange being read."""
        self.quiet_until = quiet_until
        """Time when the controller listens again (ns); in the past during normal operation."""
        self.strange = b""
        """Latest unexpected bytes."""
        self.acknowledged = False
        """True once a device has answered as an EPOS does."""
        self.began = 0
        """Time of the first byte of the latest exchange (ns)."""
        self.ended = 0
        """Time of the last byte of the latest complete exchange (ns)."""
        self.durations: deque[int] = deque(maxlen=RECENT)
        """Durations of the latest complete exchanges (ns)."""
        self._frame_timeout: float | None = None
        """Timeout for incomplete frames that the host has set in the controller (s); None: the factory setting."""
        self._answer_awaited = False
        """Whether the controller has the request, so that late bytes are its answer."""
        self._failures = 0
        """Number of consecutive failed exchanges."""
        self._silence = QUIET
        """Silence required after the latest failure (s)."""
        self._touched = 0
        """Time of the latest byte from either side (ns)."""

    async def read(self, entry: ObjectEntry, attempts: int = 1) -> int:
        """Read the value of an object.

        Raises:
            ObjectError: the controller refuses the request.
            DeviceTimeoutError, ProtocolError: no usable answer in ``attempts`` tries.
            DeviceLostError: the link is down.
        """
        return self._value(entry, await self._answer(read_request(entry, self._node), entry, attempts))

    async def read_row(self, entries: Sequence[ObjectEntry], take: Callable[[int], bool]) -> None:
        """Read objects back to back, pass each value to ``take`` immediately, and stop when it returns False.

        Reading also stops when the caller has been cancelled.

        Raises:
            ObjectError, DeviceTimeoutError, ProtocolError, DeviceLostError: the same as ``read``.
        """
        await self._transact(self._run_row(entries, take))

    async def write(self, entry: ObjectEntry, value: int, attempts: int = 1) -> None:
        """Write an object.

        Raises:
            ValueError: ``value`` does not fit the object.
            ObjectError, DeviceTimeoutError, ProtocolError, DeviceLostError: the same as ``read``.
        """
        await self._answer(write_request(entry, value, self._node), entry, attempts, value)

    async def shorten_silence(self) -> None:
        """Make the controller drop incomplete frames sooner, if supported, so that a corrupted byte costs less time.

        Raises:
            DeviceTimeoutError, ProtocolError, DeviceLostError: the same as ``read``.
        """
        quick = max(self.durations, default=SECOND) <= QUICK_ANSWER * SECOND
        # Timeout of an incomplete frame set by the host on a fast line: no valid frame takes longer.
        quick_frame_timeout_ms = 50
        # The same on other lines: more than the host waits for an acknowledge, so that only damage meets it.
        frame_timeout_ms = 120
        milliseconds = quick_frame_timeout_ms if quick else frame_timeout_ms
        with suppress(ObjectError):
            await self.write(od.RS232_TIMEOUT, milliseconds, ATTEMPTS)
            self._frame_timeout = milliseconds / 1000

    async def read_long(self, entry: ObjectEntry) -> bytes:
        """Read the raw bytes of an object longer than 32 bits, segment by segment.

        Raises:
            ObjectError, DeviceTimeoutError, ProtocolError, DeviceLostError: the same as ``read``.
        """
        await self._answer(segmented_read_request(entry, self._node), entry, 1)
        data, toggle = b"", False
        segment_limit = 16
        for _ in range(segment_limit):
            answer = await self._answer(segment_request(toggle), entry, 1)
            try:
                segment = decode_segment(answer.words[2:])
            except FrameError as error:
                raise ProtocolError(f"{self._link.name}: {entry}: {error}") from error
            data += segment.data
            if not segment.more:
                return data
            toggle = not toggle
        raise ProtocolError(f"{self._link.name}: {entry}: more than {segment_limit} segments")

    async def finish(self) -> None:
        """Wait for the exchange whose caller was cancelled, if any; ignore its outcome."""
        if self._flight is not None:
            self._hurried = True
            await self._flight.end()

    async def close(self) -> None:
        """Abandon an exchange in progress."""
        if self._flight is not None:
            self._flight.cancel()

    async def _answer(self, request: Frame, entry: ObjectEntry, attempts: int, value: int | None = None) -> Frame:
        for left in reversed(range(attempts)):
            try:
                frame = await self._transact(self._run(request))
            except (DeviceTimeoutError, ProtocolError):
                if not left:
                    raise
            else:
                return self._checked(frame, entry if value is None else f"{entry} = {value}")
        raise ValueError("at least one attempt")

    def _checked(self, frame: Frame | None, subject: object) -> Frame:
        assert frame is not None
        if code := error_of(frame):
            raise ObjectError(f"{self._link.name}: {subject}", code)
        return frame

    def _value(self, entry: ObjectEntry, frame: Frame) -> int:
        if len(frame.words) != 4:
            raise ProtocolError(f"{self._link.name}: {entry}: answer of {len(frame.words)} words")
        return entry.decode(join(frame.words[2], frame.words[3]))

    async def _transact(self, steps: Steps[T]) -> T:
        await self.finish()
        await self.settle()
        self._flight = flight = Transaction(self._link, steps)
        try:
            return await flight.result()
        finally:
            if flight.ended and self._flight is flight:
                self._flight = None  # its error's traceback holds this exchanger

    async def settle(self) -> None:
        """Make the controller drop an incomplete frame by keeping both sides of the line silent.

        Raises:
            DeviceLostError: the link went down.
        """
        quiet_limit = (
            1.1  # maximum wait for silence (s); a line that is never silent is not an EPOS, and is used anyway
        )
        limit = self._clock.now() + int(quiet_limit * SECOND)
        while (left := min(self.quiet_until, limit) - self._clock.now()) > 0:
            with suppress(TimeoutError):
                async with self._clock.deadline(left / SECOND):
                    self.strange = await self._link.read()
                    self.quiet_until = self._clock.now() + int(self._silence * SECOND)
        self._link.discard()

    def _be_silent(self, *, waited: bool) -> None:
        """Require silence from the last byte of either side after a failure, so that the controller drops its frame.

        The silence is brief if the controller drops incomplete frames early. After more than ``BRIEF_SILENCES``
        failures, and while an answer may still arrive, it is as long as the factory settings require. On a fast line,
        an answer can still arrive only if nobody ``waited`` for it, because the controller sends its last byte within
        the duration of an exchange.
        """
        quick = self._is_quick()
        last = self._touched if quick else self._clock.now()
        may_come = self._answer_awaited and not (waited and quick)
        if self._frame_timeout is None or self._failures >= BRIEF_SILENCES or may_come:
            self._silence, last = QUIET, self._clock.now()
        else:
            # Time within which bytes held back by an adapter or this host arrive (s).
            rest = max(self.durations) / SECOND + 0.01 if quick else QUICK_ANSWER
            self._silence = self._frame_timeout + rest
        self.quiet_until = last + round(self._silence * SECOND)

    def _is_quick(self) -> bool:
        """Whether a byte that did not arrive in time was lost rather than delayed by a slow link; the retry decides."""
        return not self._failures and len(self.durations) == RECENT and max(self.durations) <= QUICK_ANSWER * SECOND

    def _run_row(self, entries: Sequence[ObjectEntry], take: Callable[[int], bool]) -> Steps[None]:
        self._hurried = False
        for entry in entries:
            self._link.discard()
            frame = yield from self._run(read_request(entry, self._node))
            if not take(self._value(entry, self._checked(frame, entry))) or self._hurried:
                return

    def _run(self, request: Frame) -> Steps[Frame]:
        """Run one exchange; a failure is followed by silence."""
        self.began = self._clock.now()
        self._answer_awaited = False
        try:
            frame = yield from self._converse(request)
        except (_BusyError, _HeldUpError) as error:
            raise DeviceTimeoutError(str(error)) from None
        except BaseException as error:
            self._be_silent(waited=isinstance(error, DeviceTimeoutError))
            self._failures += 1
            self._link.discard()  # bytes of the failed exchange do not show that the controller still answers
            raise
        self._failures = 0
        self.ended = self._clock.now()
        self.durations.append(self.ended - self.began)
        return frame

    def _converse(self, request: Frame) -> Steps[Frame]:
        for _ in range(2):
            yield from self._send(request)
            frame = yield from self._receive(_ANSWER_LENGTHS.get(request.opcode))
            if frame is not None:
                return frame
        raise ProtocolError(f"{self._link.name}: answer damaged twice")

    def _send(self, request: Frame) -> Steps[None]:
        for _ in range(2):
            yield from self._ask(request)
            self._write(request.body)
            if (yield from self._acknowledge()) == READY:
                return
        raise ProtocolError(f"{self._link.name}: frame rejected twice")

    def _ask(self, request: Frame) -> Steps[None]:
        busy_retries = 3
        for attempt in range(1 + busy_retries):
            if attempt:
                yield WaitFor(0, 0.01)
            self._write(request.head)
            if (yield from self._acknowledge()) == READY:
                return
        raise _BusyError(f"{self._link.name}: controller stays busy")

    def _acknowledge(self) -> Steps[int]:
        skipped = b""
        acknowledge_timeout = 0.1
        while (byte := (yield from self._exactly(1, acknowledge_timeout)))[0] not in (READY, REFUSED):
            skipped = self._skipped(skipped + byte, "an acknowledge")
        self.acknowledged = True
        return byte[0]

    def _skipped(self, stray: bytes, awaited: str) -> bytes:
        """Record unknown bytes before an expected one."""
        self.strange = stray
        if len(stray) > 3:
            raise ProtocolError(f"{self._link.name}: {stray.hex(' ')} instead of {awaited}")
        return stray

    def _receive(self, lengths: frozenset[int] | None) -> Steps[Frame | None]:
        """Read the answer frame; None if the controller has dropped a damaged one, so the request must be repeated."""
        self._answer_awaited = True
        skipped = b""
        answer_timeout = 0.25
        while (byte := (yield from self._exactly(1, answer_timeout)))[0] != ANSWER:
            skipped = self._skipped(skipped + byte, "an answer")
        self._answer_awaited = False
        self._write(bytes((READY,)))
        frame: Frame | None
        try:
            frame = yield from self._frame(lengths)
        except FrameError:
            frame = yield from self._repeated(lengths)
        if frame is not None:
            self._write(bytes((READY,)))
        return frame

    def _repeated(self, lengths: frozenset[int] | None) -> Steps[Frame | None]:
        """Reject a damaged answer; check whether the controller repeats or drops it, which is undocumented."""
        yield WaitFor(0, 0.005)  # seconds within which the rest of a damaged answer arrives
        self._link.discard()
        self._write(bytes((REFUSED,)))
        try:
            repeat_wait = 0.03  # seconds within which a controller starts to repeat a rejected answer
            return (yield from self._frame(lengths, repeat_wait))
        except DeviceTimeoutError:
            return None
        except FrameError as error:
            raise ProtocolError(f"{self._link.name}: repeated answer is damaged too: {error}") from error

    def _frame(self, lengths: frozenset[int] | None, within: float | None = None) -> Steps[Frame]:
        begin, timeout = self._clock.now(), 0.1  # seconds for each part of a frame
        head = yield from self._exactly(1, within or timeout)
        if lengths is not None and head[0] not in lengths:
            raise FrameError(f"length byte {head[0]}")
        left = within - (self._clock.now() - begin) / SECOND if within else timeout
        return decode_body(ANSWER, head + (yield from self._exactly(body_size(head[0]), left)))

    def _write(self, data: bytes) -> None:
        self._link.write(data)
        self._touched = self._clock.now()

    def _exactly(self, count: int, timeout: float) -> Steps[bytes]:
        asked = self._clock.now()
        if self._is_quick():
            timeout = min(timeout, QUICK_ANSWER)
        try:
            data = yield WaitFor(count, timeout)
        except TimeoutError:
            self._check_held_up(asked)
            raise DeviceTimeoutError(f"{self._link.name}: no answer within {timeout} s") from None
        self._check_held_up(asked)
        self._touched = self._clock.now()
        return data

    def _check_held_up(self, asked: int) -> None:
        if (waited := (self._clock.now() - asked) / SECOND) >= QUIET:
            raise _HeldUpError(f"{self._link.name}: this process was suspended for {waited:.1f} s")


class _BusyError(Exception):
    """The controller repeatedly refused an opcode; no frame is incomplete."""


class _HeldUpError(Exception):
    """This process was suspended during an exchange.

    The controller has already dropped the exchange and accepts a new one immediately.
    """


@dataclass(frozen=True, slots=True)
class ControllerIdentity:
    """Controller identity and settings; None for missing objects."""

    software: int
    hardware: int | None
    motor_type: int | None
    sensor_type: int | None
    encoder_pulses_per_turn: int | None
    velocity_notation: int | None
    continuous_current_ma: int | None
    peak_current_ma: int | None
    pole_pairs: int | None
    motor_max_rpm: int | None

    def as_values(self) -> dict[str, int | None]:
        """Return the values by name, for events and reports."""
        return asdict(self)

    def counts_per_turn(self, config: EposConfig) -> int:
        """Position counts per motor turn.

        Raises:
            DeviceMismatchError: neither the controller nor the configuration defines the counts.
        """
        pulses = self.encoder_pulses_per_turn or config.encoder_pulses_per_turn
        if pulses is None:
            raise DeviceMismatchError(f"controller lacks {od.ENCODER_PULSES}: configure encoder_pulses_per_turn")
        return pulses * od.COUNTS_PER_PULSE

    def check(self, config: EposConfig) -> None:
        """Check the controller against the configuration.

        Raises:
            DeviceMismatchError: the speed would be wrong by a factor, or the motor type differs.
        """
        expected: tuple[tuple[ObjectEntry, int | None, int | None], ...] = (
            (od.ENCODER_PULSES, self.encoder_pulses_per_turn, config.encoder_pulses_per_turn),
            (od.MOTOR_TYPE, self.motor_type, config.motor_type),
            (od.VELOCITY_NOTATION, self.velocity_notation, od.RPM),
        )
        wrong = [
            f"{entry} is {value}, expected {want}"
            for entry, value, want in expected
            if value is not None and want is not None and value != want
        ]
        if wrong:
            raise DeviceMismatchError("; ".join(wrong))


async def read_identity(line: Exchanger) -> ControllerIdentity:
    """Read the identity from the controller.

    Raises:
        WrongDeviceError: the answering device has no software version.
        DeviceTimeoutError, ProtocolError, DeviceLostError: the same as ``Exchanger.read``.
    """

    async def ask(entry: ObjectEntry) -> int | None:
        try:
            return await line.read(entry, ATTEMPTS)
        except ObjectError:
            return None

    software = await ask(od.SOFTWARE_VERSION)
    if software is None:
        raise WrongDeviceError(f"controller without {od.SOFTWARE_VERSION}: not an EPOS 24/1, or another node id")
    return ControllerIdentity(
        software=software,
        hardware=await ask(od.HARDWARE_VERSION),
        motor_type=await ask(od.MOTOR_TYPE),
        sensor_type=await ask(od.SENSOR_TYPE),
        encoder_pulses_per_turn=await ask(od.ENCODER_PULSES),
        velocity_notation=await ask(od.VELOCITY_NOTATION),
        continuous_current_ma=await ask(od.CONTINUOUS_CURRENT),
        peak_current_ma=await ask(od.PEAK_CURRENT),
        pole_pairs=await ask(od.POLE_PAIRS),
        motor_max_rpm=await ask(od.MOTOR_MAX_SPEED),
    )
