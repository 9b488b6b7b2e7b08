"""Requests to the controller and its replies over one open link; shared by the driver and `identify`."""

from typing import Final

from monstertruck_drivers.link import Link
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.steppers.protocol import (
    NAME,
    SEQUENCES,
    Identity,
    Line,
    LineError,
    RefusalCode,
    Splitter,
    Status,
)
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError

ASK_ATTEMPTS: Final = 3
"""Attempts for each request at the start of a session."""


class RequestRefusedByDeviceError(ProtocolError):
    """The controller refuses a request.

    Args:
        text: controller, request and reason.
        code: the controller's error code.
    """

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


class StepperSession:
    """One session. The sequence number matches an answer to its request; late answers are dropped.

    Args:
        link: open link.
        clock: time.
        timeout: maximum time to wait for an answer (s).
    """

    def __init__(self, link: Link, clock: Clock, timeout: float) -> None:
        self.splitter = Splitter()
        self.asked = 0
        """Send time of the latest request (ns)."""
        self.heard = False
        """Whether a line of the protocol has arrived."""
        self._link = link
        self._clock = clock
        self._timeout = timeout
        self._seq = 0

    def send(self, verb: str, *words: int) -> int:
        """Send a request without waiting for its answer; return its sequence number.

        Raises:
            DeviceLostError: the controller was unplugged.
        """
        self._seq = (self._seq + 1) % SEQUENCES
        self._link.write(bytes(Line(verb, self._seq, tuple(map(str, words)))))
        return self._seq

    async def ask(self, verb: str, *words: int, attempts: int = 1) -> Line:
        """Send a request and wait for its answer.

        Raises:
            DeviceLostError: the controller was unplugged.
            DeviceTimeoutError: the answer did not arrive within the timeout.
            ProtocolError: the controller refuses the request.
        """
        for _ in range(attempts):
            self.asked = self._clock.now()
            answer = await self._answer(self.send(verb, *words))
            if answer is not None:
                if answer.verb == "e":
                    code, why = _reason(answer)
                    raise RequestRefusedByDeviceError(f"{self._link.name}: request {verb} refused: {why}", code)
                return answer
        raise DeviceTimeoutError(f"{self._link.name}: no answer to {verb} within {self._timeout} s")

    async def status(self, verb: str, motors: int, *words: int, attempts: int = 1) -> Status:
        """Send a request that is answered with a status; raises the same errors as ``ask``."""
        answer = await self.ask(verb, *words, attempts=attempts)
        try:
            return Status.of(answer, motors)
        except LineError as error:
            raise ProtocolError(f"{self._link.name}: {error}") from error

    async def identify(self) -> Identity:
        """Identify the controller.

        Raises:
            DeviceLostError: the controller was unplugged.
            DeviceTimeoutError: the controller is silent.
            WrongDeviceError: another device answers.
        """
        try:
            identity = Identity.of(await self.ask("I", attempts=ASK_ATTEMPTS))
        except (DeviceTimeoutError, ProtocolError, LineError) as error:
            if self.splitter.bad and not self.heard:
                text = f"{self._link.name}: not {NAME}, it sends {self.splitter.strange!r}"
                raise WrongDeviceError(text) from error
            if isinstance(error, LineError):
                raise ProtocolError(f"{self._link.name}: {error}") from error
            raise
        if identity.name != NAME:
            raise WrongDeviceError(f"{self._link.name}: identifies itself as {identity.name}, expected {NAME}")
        return identity

    async def _answer(self, seq: int) -> Line | None:
        due = self._clock.now() + round(self._timeout * SECOND)
        while (left := due - self._clock.now()) > 0:
            try:
                data = await self._link.read(left / SECOND)
            except TimeoutError:
                return None
            for line in self.splitter.feed(data):
                if line.verb.islower():
                    self.heard = True
                    if line.seq == seq:
                        return line
        return None


def _reason(answer: Line) -> tuple[int, str]:
    try:
        code = RefusalCode(answer.integers(1)[0])
    except ValueError:
        return 0, " ".join(answer.words)
    return code, code.name.lower()


async def identify(link: Link, clock: Clock, settings: StepperConfig) -> dict[str, object]:
    """Read the identity and one status without moving or changing anything.

    Returns:
        JSON-compatible dict: ``version``, ``motors``, ``steps_per_turn``, ``state``, ``bad_lines``, ``uptime_s``,
        ``positions`` (steps), ``rates`` (steps/s).

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    session = StepperSession(link, clock, settings.answer_timeout)
    identity = await session.identify()
    status = await session.status("S", identity.motors, attempts=ASK_ATTEMPTS)
    return {
        "version": identity.version,
        "motors": identity.motors,
        "steps_per_turn": identity.steps_per_turn,
        "state": status.state.name.lower(),
        "bad_lines": status.bad_lines,
        "uptime_s": status.uptime_ms / 1000,
        "positions": list(status.positions),
        "rates": [rate / 1000 for rate in status.rates],
    }
