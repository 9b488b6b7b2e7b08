"""The conversation with sensors that answer otherwise than the emulated one."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from pydantic import ValidationError

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.hokuyo_urg.driver import Dialect, HokuyoDriver, ScipSession
from monstertruck_drivers.hokuyo_urg.protocol import build_fields, build_reply
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from tests.unit.drivers.kit import Events, Kept

VV = {"VEND": "H", "PROD": "SOKUIKI Sensor URG-04LX", "FIRM": "3.1", "PROT": "SCIP 2.0", "SERI": "H1"}
PP = {"MODL": "URG-04LX", "DMIN": 20, "DMAX": 5600, "ARES": 1024, "AMIN": 44, "AMAX": 725, "AFRT": 384, "SCAN": 600}
II = {"LASR": "OFF", "TIME": "000001", "STAT": "Sensor works well."}
HEALTHY = {
    "QT": [build_reply("QT", "00")],
    "VV": [build_reply("VV", "00", build_fields(VV))],
    "PP": [build_reply("PP", "00", build_fields(PP))],
    "II": [build_reply("II", "00", build_fields(II))],
    "TM0": [build_reply("TM0", "00")],
    "TM1": [build_reply("TM1", "00", [b"00010"[:4] + b"1"])],
    "TM2": [build_reply("TM2", "00")],
    "MD0044072501000": [build_reply("MD0044072501000", "00")],
    "SCIP2.0": [],
}


class Script:
    """A device that answers each request with the next of its lines, the last one for ever."""

    def __init__(self, **answers: list[bytes]) -> None:
        self.answers = {key: list(value) for key, value in {**HEALTHY, **answers}.items()}
        self.heard: list[str] = []

    async def run(self, port: MemoryPort) -> None:
        rest = b""
        while True:
            *lines, rest = (rest + await port.device.read()).split(b"\n")
            for line in lines:
                self.heard.append(line.decode())
                answers = self.answers.get(self.heard[-1], [])
                if answers:
                    port.device.write(answers.pop(0) if len(answers) > 1 else answers[0])


def converse(script: Script, talk: Callable[[ScipSession, VirtualClock], Awaitable[Any]]) -> Any:
    async def main(clock: VirtualClock) -> Any:
        port = MemoryPort("lidar")
        port.plug()
        device = asyncio.create_task(script.run(port))
        try:
            async with await port.open() as link:
                return await talk(ScipSession(link, clock, HokuyoConfig()), clock)
        finally:
            device.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await device

    return run_virtual(main)


def drive(script: Script) -> None:
    async def main(clock: VirtualClock) -> None:
        port = MemoryPort("lidar")
        port.plug()
        device = asyncio.create_task(script.run(port))
        try:
            await HokuyoDriver(HokuyoConfig(), port, clock, Kept(), Events()).run(lambda: None)
        finally:
            device.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await device

    run_virtual(main)


async def handshake(session: ScipSession, _clock: VirtualClock) -> Any:
    return await session.handshake()


def test_handshake_of_a_healthy_sensor():
    sensor = converse(Script(), handshake)
    assert sensor.dialect is Dialect.SCIP2
    assert sensor.identity.serial == "H1"


def test_a_busy_sensor_is_asked_once_more():
    script = Script(PP=[build_reply("PP", "0B"), *HEALTHY["PP"]])
    assert converse(script, handshake).parameters.last_step == 725
    assert script.heard.count("PP") == 2


def test_a_sensor_that_stays_busy_is_refused():
    with pytest.raises(ProtocolError, match="PP refused with status 0B"):
        converse(Script(PP=[build_reply("PP", "0B")]), handshake)


def test_firmware_update_mode_is_left_by_a_reset():
    script = Script(QT=[build_reply("QT", "0I"), *HEALTHY["QT"]], RS=[build_reply("RS", "00")])
    converse(script, handshake)
    assert script.heard[:3] == ["QT", "RS", "QT"]


def test_lost_answers_to_qt_are_asked_for_again():
    script = Script(QT=[b"rub", b"bish\n", *HEALTHY["QT"]])
    converse(script, handshake)
    assert script.heard.count("QT") == 3


def test_internal_errors_are_device_faults():
    with pytest.raises(DeviceFaultError, match="VV answered with fault 0A"):
        converse(Script(VV=[build_reply("VV", "0A")]), handshake)


def test_a_missing_answer_is_a_timeout_after_a_line_time():
    async def talk(session: ScipSession, clock: VirtualClock) -> int:
        start = clock.now()
        with pytest.raises(DeviceTimeoutError, match="no answer to PP"):
            await session.ask("PP")
        return clock.now() - start

    assert converse(Script(PP=[]), talk) == pytest.approx(0.14 * SECOND, abs=1_000_000)


def test_another_protocol_version_is_refused():
    lines = build_fields({**VV, "PROT": "SCIP 3.0"})
    with pytest.raises(ProtocolError, match="expected SCIP 2"):
        converse(Script(VV=[build_reply("VV", "00", lines)]), handshake)


def test_a_missing_serial_number_is_empty():
    lines = build_fields({key: value for key, value in VV.items() if key != "SERI"})
    assert converse(Script(VV=[build_reply("VV", "00", lines)]), handshake).identity.serial == ""


def test_chatter_that_never_ends_is_refused():
    async def talk(session: ScipSession, clock: VirtualClock) -> None:
        async def chatter() -> None:
            while True:
                session._link.feed(b"MD0044072501000\n99b\n\n")
                await clock.sleep(0.1)

        noise = asyncio.create_task(chatter())
        try:
            await session.handshake()
        finally:
            noise.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await noise

    with pytest.raises(ProtocolError, match="keeps sending"):
        converse(Script(), talk)


def test_a_busy_sensor_that_chatters_is_asked_again_all_the_same():
    async def talk(session: ScipSession, clock: VirtualClock) -> str:
        async def chatter() -> None:
            while True:
                await clock.sleep(0.1)
                session._link.feed(b"MD0044072501000\n99b\n\n")

        noise = asyncio.create_task(chatter())
        try:
            return (await session.ask("PP")).status
        finally:
            noise.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await noise

    assert converse(Script(PP=[build_reply("PP", "0B"), *HEALTHY["PP"]]), talk) == "00"


def test_scan_blocks_before_an_answer_are_passed_over():
    stray = b"MD0044072501000\n99b\n00010\n\n"

    async def talk(session: ScipSession, _clock: VirtualClock) -> str:
        return (await session.ask("PP")).echo

    assert converse(Script(PP=[stray + HEALTHY["PP"][0]]), talk) == "PP"


def test_the_quickest_clock_comparison_counts():
    async def talk(session: ScipSession, clock: VirtualClock) -> tuple[int, int, int]:
        start = clock.now()
        delays = iter([0.02, 0.004, 0.03, *[0.02] * 20])
        transmit = session._link._transmit

        def slow(data: bytes) -> None:
            asyncio.get_running_loop().call_later(next(delays) if data == b"TM1\n" else 0, transmit, data)

        session._link._transmit = slow  # type: ignore[method-assign]
        anchor = await session.compare_clocks()
        return anchor.counter, anchor.host - start, anchor.round_trip

    counter, host, round_trip = converse(Script(), talk)
    assert counter == 1
    assert round_trip == pytest.approx(4_000_000, abs=1000)
    assert host == pytest.approx(22_000_000, abs=1000)


def test_a_clock_answer_without_time_is_refused():
    with pytest.raises(ProtocolError, match="time line"):
        drive(Script(TM1=[build_reply("TM1", "00")]))


def test_without_its_time_adjust_mode_it_streams_all_the_same():
    """Twelve restarts in six seconds, and no scan."""
    with pytest.raises(DeviceTimeoutError, match="no valid scan"):  # the stream began; the script ends there
        drive(Script(TM0=[build_reply("TM0", "01")]))


def test_a_status_that_no_stream_has():
    ack = HEALTHY["MD0044072501000"][0]
    with pytest.raises(ProtocolError, match="status 07 within a stream"):
        drive(Script(MD0044072501000=[ack + build_reply("MD0044072501000", "07")]))


def test_replies_to_nothing_are_passed_over_in_a_stream():
    ack = HEALTHY["MD0044072501000"][0]
    script = Script(MD0044072501000=[ack + build_reply("II", "00")])
    with pytest.raises(DeviceTimeoutError, match="no valid scan"):
        drive(script)
    assert script.heard[-1] == "QT"


def test_damaged_answers_of_an_old_unit_are_counted_and_end_the_session():
    old = {
        "QT": [build_reply("QT", "E")],
        "SCIP2.0": [build_reply("SCIP2.0", "E")],
        "V": [build_reply("V", "0", [b"PROD:URG-04LX;", b"FIRM:2.0;"])],
        "L1": [build_reply("L1", "0")],
        "G04472501": [build_reply("G04472501", "0", [b"0000"])],
    }
    script = Script(**old)
    with pytest.raises(ProtocolError, match="6 damaged scans in a row"):
        drive(script)
    assert script.heard[-1] == "L0"


def test_configuration_is_checked():
    with pytest.raises(ValidationError):
        HokuyoConfig(scan_format="GD")  # type: ignore[arg-type]
    with pytest.raises(ValidationError):
        HokuyoConfig(cluster=0)
    with pytest.raises(ValidationError):
        HokuyoConfig(port="x")  # type: ignore[call-arg]


def test_what_was_left_in_the_pipe_is_thrown_away_before_the_first_request():
    script = Script()

    async def talk(session: ScipSession, clock: VirtualClock) -> int:
        task = asyncio.create_task(session.handshake())
        await clock.sleep(0.04)
        assert script.heard == []
        session._link.feed(b"00P\n\nQT\n0")
        await task
        return session.parser.rejected

    assert converse(script, talk) == 1
    assert script.heard[0] == "QT"
