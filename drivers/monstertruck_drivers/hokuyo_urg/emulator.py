"""Emulated URG-04LX, byte for byte: power-up state, both dialects, streaming, time and faults.

Three tasks run forever: one reads request lines, one answers them after a delay, and one is the rotor, which turns
every 100 ms of the sensor's clock with or without a client. A requested stream ends with QT, with RS, after its count
or at power loss; it continues if the host dies.

Where the specification is silent the emulator answers TM0 during a scan with 0A, MD during a stream with 0B,
and everything but TM and RS in time-adjust mode with 0E.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, RangeSource
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.hokuyo_urg.models import URG_04LX, ScannerModel
from monstertruck_drivers.hokuyo_urg.protocol import (
    COUNTER_MASK,
    RANGE_WIDTH,
    TAG_LIMIT,
    build_fields,
    build_reply,
    encode,
    encode_array,
    line_sum,
    wrap_lines,
)
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock


@dataclass(frozen=True, slots=True)
class ScanOrder:
    """A requested scan."""

    command: str
    """MD, MS, GD, GS or G."""
    start: int
    end: int
    cluster: int = 1
    skip: int = 0
    left: int | None = None
    """Number of scans still to send; None: endless."""
    prefix: str = ""
    """Request without remaining count and tag."""
    tag: str = ""

    @property
    def echo(self) -> str:
        """First line of the next scan block."""
        return f"{self.prefix}{self.left or 0:02d}" + (f";{self.tag}" if self.tag else "")


def parse_order(text: str, tag: str = "", greatest: int = URG_04LX.greatest_step) -> ScanOrder | str:
    """Parse a scan request (MD, GS ...) for steps up to ``greatest``; return its two-character status if rejected."""
    command, digits = text[:2], text[2:]
    multi = command[0] == "M"
    wanted = 13 if multi else 10
    if len(digits) != wanted:
        return "0C" if len(digits) < wanted else "0D"
    parts = [digits[0:4], digits[4:8], digits[8:10], digits[10:11] or "0", digits[11:13] or "0"]
    for part, status in zip(parts, ("01", "02", "03", "06", "07"), strict=True):
        if not part.isdigit():
            return status
    start, end, cluster, skip, count = (int(part) for part in parts)
    if end > greatest:
        return "04"
    if end < start:
        return "05"
    return ScanOrder(command, start, end, max(cluster, 1), skip, count or None, text[:13], tag)


def parse_scip1_order(text: str) -> ScanOrder | None:
    """Parse the SCIP 1.1 request G; None if it is rejected."""
    digits = text[1:]
    if text[:1] != "G" or len(digits) != 8 or not digits.isdigit():
        return None
    start, end, cluster = int(digits[:3]), int(digits[3:6]), int(digits[6:])
    return ScanOrder("G", start, end, max(cluster, 1)) if start <= end <= URG_04LX.greatest_step else None


def scan_lines(order: ScanOrder, counter: int, revolution: NDArray[np.int32]) -> list[bytes]:
    """Lines of a scan after its status: the time line (not in SCIP 1.1) and the data lines.

    Args:
        order: requested scan.
        counter: time at step 0 (ms, 24 bits).
        revolution: values of all steps (mm or error codes).
    """
    values = _clustered(revolution[order.start : order.end + 1], order.cluster)
    if order.command.endswith("E"):
        values = np.column_stack((values, _strength(values))).reshape(-1)
    width = RANGE_WIDTH[order.command]
    payload = encode_array(np.minimum(values, (1 << 6 * width) - 1), width)
    if order.command == "G":
        return wrap_lines(payload, sums=False)
    return [counter_line(counter), *wrap_lines(payload)]


def _strength(values: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return intensities for ranges (mm); they decrease with distance."""
    bright = 4000  # intensity of a near white surface; it decreases with the distance
    fading = 6000  # distance that halves the intensity, mm
    return np.rint(bright / (1.0 + (np.maximum(values, 0) / fading) ** 2)).astype(np.int32)


def counter_line(counter: int) -> bytes:
    """Time line with its checksum."""
    text = encode(counter, 4)
    return text + bytes((line_sum(text),))


def _clustered(values: NDArray[np.int32], cluster: int) -> NDArray[np.int32]:
    """Minimum valid value of each group of neighbours, or the first code of the group if none is valid."""
    if cluster == 1:
        return values
    groups = np.pad(values, (0, -len(values) % cluster)).reshape(-1, cluster)
    huge = np.iinfo(np.int32).max
    least = np.where(groups >= URG_04LX.least_mm, groups, huge).min(axis=1)
    return np.where(least < huge, least, groups[:, 0]).astype(np.int32)


DEFAULT_BAUD: Final = 19200

StartState = Literal["scip1", "scip2", "streaming", "time_adjust"]
ORDERED: Final = {"BM": "laser_on", "MD": "stream", "MS": "stream", "QT": "quit", "RS": "reset", "TM": "adjust"}
"""Requests that change the sensor's state, with the names of their signals."""
RANGE: Final = "range"
"""Signal: distances of a scan (mm)."""
COUNTER: Final = "counter"
"""Signal: time stamp of a scan (ms)."""

Handler = Callable[[str, str], tuple[str, list[bytes]]]
"""Handler of a request and its tag; returns a status and lines."""
Cover = Callable[[NDArray[np.int32]], NDArray[np.int32]]
"""Maps the values (n,) of the covered steps."""


class HokuyoEmulator(FaultyDevice):
    """Emulated scanner.

    Faults (``inject``): ``status N`` sends that status with the next revolution of a stream: 21-49 hold the stream
    until 98, 50-97 end it. ``deaf`` ignores requests; ``fragile``: an unknown command makes the sensor deaf. ``cut``
    ends the next scan in the middle of a line. ``laser`` keeps the laser off. ``seri`` puts a wrong checksum on SERI
    and an empty line into VV. ``tm`` makes the sensor refuse its time-adjust mode. ``timer`` sets the counter, and
    ``drift`` the rate error of the sensor's clock. ``cover`` covers the window between two directions (degrees from
    straight ahead, left positive): the beams, or a random share of them, return the value (below 20: an error code,
    otherwise mm). ``mirror`` puts a mirror there: its middle dazzles the sensor; the rest shows the room behind the
    mirror, at twice the distance.

    Args:
        clock: world time.
        source: range source, read at the end of each revolution that is sent.
        seed: seed for the USB jitter.
        model: scanner model.
        state: initial state: freshly powered (SCIP 1.1), configured to start in SCIP 2.0, left streaming or
            in time-adjust mode by a dead host.
        serial: ``SERI`` of VV.
        firmware: ``FIRM`` of VV; a major version below 3 supports SCIP 1.1 only.
        timer_start: counter at construction (ms).
        drift_ppm: rate error of the sensor's clock; positive if it runs fast.
        jitter: maximum delay of a scan caused by USB batching (s).
        min_step: first measuring step (``AMIN``); default: the model's value.
        max_step: last measuring step (``AMAX``); default: the model's value.
    """

    def __init__(
        self,
        clock: Clock,
        source: RangeSource,
        *,
        seed: int = 0,
        model: ScannerModel = URG_04LX,
        state: StartState = "scip1",
        serial: str = "H0706400",
        firmware: str = "3.1.04(02/Aug./2007)",
        timer_start: int = 0,
        drift_ppm: float = 0.0,
        jitter: float = 0.0,
        min_step: int | None = None,
        max_step: int | None = None,
    ) -> None:
        self.name = "lidar"
        self.received: deque[str] = deque(maxlen=1000)
        """Latest request lines, for tests."""
        self._clock = clock
        self._source = source
        self._rng = np.random.default_rng(seed)
        kinds = {RANGE: SignalKind.ARRAY, COUNTER: SignalKind.NUMBER}
        kinds |= dict.fromkeys(ORDERED.values(), SignalKind.SWITCH)
        self.signals = Signals(clock.now, kinds, self._rng, codes={RANGE: model.least_mm})
        self._state: StartState = state
        self._identity = {"SERI": serial, "FIRM": firmware}
        self._rate = 1.0 + drift_ppm * 1e-6
        self._jitter = jitter
        self._model = model
        self._steps = (
            model.first_step if min_step is None else min_step,
            model.last_step if max_step is None else max_step,
        )
        self._born = clock.now()
        self._tm_refused = False
        self.faults = FaultTable(
            self.name,
            {
                "status 21..98": self._inject_status,
                "deaf|fragile|laser|seri [on|off]": False,
                "cut": 0,
                "tm [on|off]": self._inject_tm,
                "timer MILLISECONDS": self._inject_timer,
                "drift PPM": self._inject_drift,
                "cover FROM TO VALUE [SHARE]|off": self._inject_cover,
                "mirror FROM TO": self._inject_mirror,
            },
        )
        self._elapsed = 0
        """Sensor time at ``_born`` (ns)."""
        self._covers: list[tuple[slice, Cover]] = []
        self._order: ScanOrder | None = None
        self._statuses: deque[int] = deque()
        self._pending: list[str] = []
        self._requests: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
        self._power_up()
        self._scip2 = state != "scip1"
        self._adjusting = state == "time_adjust"
        self._timer_zero = self._time() - timer_start * 1_000_000
        if state == "streaming":
            self._laser = True
            self._order = ScanOrder("MD", *self._steps, prefix="MD{:04d}{:04d}010".format(*self._steps))

    # Emulator protocol

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._listen(end), name=f"{self.name} requests")
            tasks.create_task(self._serve(end), name=f"{self.name} answers")
            tasks.create_task(self._turn(end), name=f"{self.name} turns")

    def power_cycle(self) -> None:
        """Switch the supply off and on: SCIP 1.1 unless configured to start in 2.0, counter at zero, no longer deaf."""
        self._power_up()
        self._scip2 = self._state == "scip2"

    def _inject_status(self, code: str) -> None:
        if not 21 <= int(code) <= 98:
            raise ValueError(code)
        self._statuses.append(int(code))

    def _inject_tm(self, obeys: bool = False) -> None:
        self._tm_refused = not obeys

    def _inject_timer(self, milliseconds: str) -> None:
        self._timer_zero = self._time() - int(milliseconds) * 1_000_000

    def _inject_drift(self, ppm: str) -> None:
        rate = 1.0 + float(ppm) * 1e-6
        self._elapsed, self._born = self._time(), self._clock.now()
        self._rate = rate

    def _inject_cover(self, begin: str, end: str = "", value: str = "", share: str = "1") -> None:
        if begin == "off":
            self._covers.clear()
            return
        shown, part = int(value), float(share)

        def cover(values: NDArray[np.int32]) -> NDArray[np.int32]:
            return np.where(self._rng.random(len(values)) < part, np.int32(shown), values)

        self._covers.append((self._steps_between(begin, end), cover))

    def _inject_mirror(self, begin: str, end: str) -> None:
        def mirror(values: NDArray[np.int32]) -> NDArray[np.int32]:
            model = self._model
            values = np.where(values >= model.least_mm, 2 * values, values)
            values[values > model.greatest_mm] = model.unreturned
            specular = 0.2  # fraction of a mirror, around its middle, that reflects the light straight back
            half = round(len(values) * specular / 2)
            values[len(values) // 2 - half : len(values) // 2 + half] = model.dazzled
            return values

        self._covers.append((self._steps_between(begin, end), mirror))

    def _steps_between(self, begin: str, end: str) -> slice:
        """Steps between two directions (degrees from straight ahead, left positive)."""
        model = self._model
        first, last = (
            model.front_step + round(float(degrees) * model.steps_per_turn / 360) for degrees in (begin, end)
        )
        if not 0 <= first < last <= model.greatest_step:
            raise ValueError(f"{begin}..{end} degrees")
        return slice(first, last + 1)

    # Supply and time

    def _power_up(self) -> None:
        self._scip2 = self._adjusting = self._laser = self._verifying = False
        self.faults["deaf"] = False
        self._baud = DEFAULT_BAUD
        self._next_baud: int | None = None
        self._order = None
        self._skipped = 0
        self._ordered = 0
        self._input = b""
        self._statuses.clear()
        self._pending.clear()
        while not self._requests.empty():
            self._requests.get_nowait()
        self._timer_zero = self._time()

    def _time(self) -> int:
        """Sensor time (ns since construction)."""
        return self._elapsed + round((self._clock.now() - self._born) * self._rate)

    def _world_time(self, time: int) -> int:
        """World time at a sensor time (ns)."""
        return self._born + round((time - self._elapsed) / self._rate)

    def _counter(self, time: int) -> int:
        return (time - self._timer_zero) // 1_000_000 & COUNTER_MASK

    # Rotor

    async def _turn(self, end: DeviceEnd) -> None:
        begin: int | None = None
        while (begin := await self._next_revolution(begin)) is not None:
            await self._clock.sleep_until(self._sent_at(begin))
            order = self._order
            if order is None or begin < self._ordered:
                continue
            if self._statuses:
                self._send_status(end, order, self._statuses.popleft())
            elif not self._verifying:
                self._send_scan(end, order, begin)

    async def _next_revolution(self, previous: int | None) -> int | None:
        """Sensor time at step 0 of the revolution after ``previous``; None if the rotor has stopped permanently."""
        period = self._model.period
        if previous is None:
            return -(-self._time() // period) * period
        late = (self._time() - previous) // period
        catch_up = 5  # number of revolutions sent late after the host's machine slept; older ones are lost
        return previous + period * (1 if late <= catch_up else late)

    def _latest_revolution(self) -> int:
        """Sensor time at step 0 of the last complete revolution."""
        period = self._model.period
        return (self._time() - self._sweep()) // period * period

    def _measure(self, begin: int) -> NDArray[np.int32]:
        """Measure the values of all steps (mm or error codes)."""
        revolution = self._source.scan(self._world_time(begin))
        if self._covers:
            revolution = revolution.copy()
            for steps, cover in self._covers:
                revolution[steps] = cover(revolution[steps])
        return revolution

    def _sweep(self) -> int:
        processing = 1_500_000  # nanoseconds from the last step to the first byte
        return self._steps[1] * self._model.period // self._model.steps_per_turn + processing

    def _sent_at(self, begin: int) -> int:
        """World time at which the host receives the scan that started at ``begin``."""
        late = self._rng.uniform(0.0, self._jitter) if self._jitter > 0 else 0.0
        return self._world_time(begin + self._sweep()) + round(late * SECOND)

    def _send_scan(self, end: DeviceEnd, order: ScanOrder, begin: int) -> None:
        self._skipped += 1
        if self._skipped <= order.skip:
            return
        self._skipped = 0
        if order.left is not None:
            order = replace(order, left=order.left - 1)
            self._order = order
        block = build_reply(order.echo, "99", self._data(order, begin))
        if self.faults.strikes("cut"):
            block = block[: len(block) // 2]
        end.write(block)
        if order.left == 0:
            self._order, self._laser = None, False

    def _send_status(self, end: DeviceEnd, order: ScanOrder, code: int) -> None:
        end.write(build_reply(order.echo, f"{code:02d}"))
        self._verifying = 21 <= code <= 49
        if 50 <= code <= 97:
            self._order, self._laser = None, False

    def _data(self, order: ScanOrder, begin: int) -> list[bytes]:
        counter = self.signals.report(COUNTER, self._counter(begin)) & COUNTER_MASK
        return scan_lines(order, counter, np.maximum(self.signals.report(RANGE, self._measure(begin)), 0))

    # Requests

    async def _listen(self, end: DeviceEnd) -> None:
        while True:
            self._input += await end.read()
            *lines, self._input = self._input.replace(b"\r", b"\n").split(b"\n")
            for raw in lines:
                line = raw.decode("latin-1")
                if line and not self.faults["deaf"]:
                    self.received.append(line)
                    self._requests.put_nowait((line, line in self._pending))
                    self._pending.append(line)

    async def _serve(self, end: DeviceEnd) -> None:
        while True:
            line, repeated = await self._requests.get()
            await self._clock.sleep(0.0005)  # seconds from a request to its answer
            if line in self._pending:
                self._pending.remove(line)
            answer = self._answer_scip2(line, repeated) if self._scip2 else self._answer_scip1(line)
            end.write(answer)
            if self._next_baud is not None:
                self._baud, self._next_baud = self._next_baud, None
                end.baud = None if end.baud is None else self._baud  # USB has none

    def _answer_scip1(self, line: str) -> bytes:
        if line == "SCIP2.0" and not self._identity["FIRM"].startswith(("1.", "2.")):
            self._scip2 = True
            return build_reply(line, "0")
        if line in ("L0", "L1"):
            self._laser = line == "L1" and not self.faults["laser"]
            return build_reply(line, "0" if self._laser == (line == "L1") else "E")
        if line == "V":
            return build_reply(line, "0", [f"{key}:{value};".encode() for key, value in self._version().items()])
        order = parse_scip1_order(line)
        if order is not None and self._laser:
            return build_reply(line, "0", self._data(order, self._latest_revolution()))
        return build_reply(line, "E")

    def _answer_scip2(self, line: str, repeated: bool) -> bytes:
        text, _, tag = line.partition(";")
        if len(tag) > TAG_LIMIT:
            return build_reply(line, "0G")
        if repeated:
            return build_reply(line, "0B")
        if self._adjusting and text[:2] not in ("TM", "RS"):
            return build_reply(line, "0E")
        handler = self._handlers().get(text[:2])
        if handler is None or (len(text) > 2 and text[:2] in ("VV", "PP", "II", "BM", "QT", "RS")):
            self.faults["deaf"] = self.faults["fragile"]
            return b"" if self.faults["deaf"] else build_reply(line, "0E")
        request = partial(handler, text)
        name = ORDERED.get(text[:2])
        done = request(tag) if name is None else self.signals.order(name, tag, request)
        status, lines = ("00", list[bytes]()) if done is None else done
        reply = build_reply(line, status, lines)
        return reply.replace(b"\nFIRM", b"\n\nFIRM") if text == "VV" and self.faults["seri"] else reply

    def _handlers(self) -> dict[str, Handler]:
        """Request handlers by the first two characters of the request."""
        return {
            "VV": self._vv,
            "PP": self._pp,
            "II": self._ii,
            "BM": self._bm,
            "QT": self._qt,
            "RS": self._rs,
            "TM": self._tm,
            "SS": self._ss,
            "CR": self._cr,
            "GD": self._single,
            "GS": self._single,
            "MD": self._multi,
            "MS": self._multi,
        }

    def _version(self) -> dict[str, str]:
        return {
            "VEND": "Hokuyo Automatic Co.,Ltd.",
            "PROD": self._model.product,
            "FIRM": self._identity["FIRM"],
            "PROT": self._model.protocol if self._scip2 else "SCIP 1.1",
            "SERI": self._identity["SERI"],
        }

    def _vv(self, _text: str, _tag: str) -> tuple[str, list[bytes]]:
        lines = build_fields(self._version())
        if self.faults["seri"]:
            lines[-1] = lines[-1][:-1] + bytes(((lines[-1][-1] - 0x30 + 1) % 64 + 0x30,))
        return "00", lines

    def _pp(self, _text: str, _tag: str) -> tuple[str, list[bytes]]:
        (first, last), model = self._steps, self._model
        fields: dict[str, str | int] = {
            "MODL": model.model,
            "DMIN": model.least_mm,
            "DMAX": model.greatest_mm,
            "ARES": model.steps_per_turn,
            "AMIN": first,
            "AMAX": last,
            "AFRT": model.front_step,
            "SCAN": model.rpm,
        }
        return "00", build_fields(fields)

    def _ii(self, _text: str, _tag: str) -> tuple[str, list[bytes]]:
        fields: dict[str, str | int] = {
            "MODL": self._model.model,
            "LASR": "ON" if self._laser else "OFF",
            "SCSP": f"Initial({self._model.rpm}[rpm])<-Default setting by user",
            "MESM": "CLASSIC" if self._laser else "IDLE",
            "SBPS": f"{self._baud}[bps]" + ("<-Default setting by user" if self._baud == DEFAULT_BAUD else ""),
            "TIME": f"{self._counter(self._time()):06X}",
            "STAT": "Laser malfunction." if self.faults["laser"] else "Sensor works well.",
        }
        return "00", build_fields(fields)

    def _bm(self, _text: str, _tag: str) -> tuple[str, list[bytes]]:
        if self.faults["laser"]:
            return "01", []
        status = "02" if self._laser else "00"
        self._laser = True
        return status, []

    def _qt(self, _text: str, _tag: str) -> tuple[str, list[bytes]]:
        self._order, self._laser, self._verifying = None, False, False
        self._statuses.clear()
        return "00", []

    def _rs(self, text: str, tag: str) -> tuple[str, list[bytes]]:
        self._adjusting, self._timer_zero, self._next_baud = False, self._time(), DEFAULT_BAUD
        return self._qt(text, tag)

    def _cr(self, text: str, _tag: str) -> tuple[str, list[bytes]]:
        """Answer CR; the rotor supports only its default speed."""
        return ("03" if text == "CR00" else "04"), []

    def _tm(self, text: str, _tag: str) -> tuple[str, list[bytes]]:
        if self._tm_refused:
            return "0E", []
        if text == "TM1":
            if not self._adjusting:
                return "04", []
            return "00", [counter_line(self._counter(self._time()))]
        if text not in ("TM0", "TM2"):
            return "01", []
        enter = text == "TM0"
        if enter == self._adjusting:
            return "02" if enter else "03", []
        if enter and self._order is not None:
            return "0A", []
        self._adjusting = enter
        self._laser = False
        return "00", []

    def _ss(self, text: str, _tag: str) -> tuple[str, list[bytes]]:
        digits = text[2:]
        if len(digits) != 6:
            return "0C", []
        if not digits.isdigit():
            return "01", []
        if int(digits) not in (19200, 57600, 115200):
            return "02", []
        if int(digits) == self._baud:
            return "03", []
        self._next_baud = int(digits)
        return "00", []

    def _single(self, text: str, tag: str) -> tuple[str, list[bytes]]:
        order = parse_order(text, tag, self._model.greatest_step)
        if isinstance(order, str):
            return order, []
        if not self._laser:
            return "10", []
        return "00", self._data(order, self._latest_revolution())

    def _multi(self, text: str, tag: str) -> tuple[str, list[bytes]]:
        order = parse_order(text, tag, self._model.greatest_step)
        if isinstance(order, str):
            return order, []
        if self._order is not None:
            return "0B", []
        if self.faults["laser"]:
            self._statuses.append(50)
        self._order, self._laser, self._skipped, self._ordered = order, True, 0, self._time()
        return "00", []


def emulated(setup: EmulatorSetup) -> HokuyoEmulator:
    """Create a simulated truck's lidar."""
    return HokuyoEmulator(setup.clock, setup.room, seed=setup.seed)
