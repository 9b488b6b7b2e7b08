"""Who a sensor is and how it measures: the text fields of VV, PP and II. Pure, no I/O."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from monstertruck_drivers.hokuyo_urg.protocol import line_sum, sum_matches
from monstertruck_runtime.errors import ProtocolError


@dataclass(frozen=True, slots=True)
class Identity:
    """Answer to VV (or V)."""

    vendor: str
    product: str
    firmware: str
    protocol: str
    serial: str


@dataclass(frozen=True, slots=True)
class Parameters:
    """Answer to PP: everything the geometry of a scan follows from."""

    model: str
    least_mm: int
    """Values below are error codes."""
    greatest_mm: int
    steps_per_turn: int
    first_step: int
    """First step that measures."""
    last_step: int
    front_step: int
    """Step that looks straight ahead."""
    rpm: int

    @property
    def period(self) -> float:
        """Seconds of one revolution."""
        return 60.0 / self.rpm

    @property
    def step_time(self) -> float:
        """Seconds between neighbouring steps."""
        return self.period / self.steps_per_turn

    def angle(self, step: float) -> float:
        """Direction of a step, rad, counter-clockwise from straight ahead."""
        return (step - self.front_step) * 2.0 * math.pi / self.steps_per_turn


@dataclass(frozen=True, slots=True)
class InternalState:
    """Answer to II."""

    laser_on: bool
    speed: str
    mode: str
    counter: int
    """Milliseconds, 24 bits."""
    status: str


SCIP1_PARAMETERS: Final = Parameters("URG-04LX", 20, 4095, 1024, 44, 725, 384, 600)
"""URG-04LX of firmware below 3, which has no PP to ask; 4095 mm is the most its encoding holds."""


def parse_fields(lines: list[bytes], *, sums: bool = True) -> dict[str, str]:
    """``KEY:value;`` lines as a mapping.

    A wrong sum on SERI is accepted (some units send it so), and one that leaves out what follows ``<-`` (some models'
    II).

    Raises:
        ProtocolError: another line with a wrong sum, or not of this form.
    """
    fields: dict[str, str] = {}
    for line in lines:
        key, colon, value = line.partition(b":")
        if not colon or len(key) != 4:
            raise ProtocolError(f"SCIP: expected 'KEY:value', got {line!r}")
        if sums:
            note = line.partition(b"<-")[0]
            if not (sum_matches(line) or sum_matches(note + line[-1:]) or key == b"SERI"):
                raise ProtocolError(f"SCIP: bad checksum in {line!r}")
            value = value[:-1]
        fields[key.decode("latin-1")] = value.removesuffix(b";").decode("latin-1").strip()
    return fields


def build_fields(fields: Mapping[str, str | int]) -> list[bytes]:
    """Lines ``KEY:value;`` as firmware 3.1 sends them: the ``;`` is left out of the sum."""
    lines = []
    for key, value in fields.items():
        text = f"{key}:{value}".encode("latin-1")
        lines.append(text + b";" + bytes((line_sum(text),)))
    return lines


def parse_identity(fields: dict[str, str]) -> Identity:
    """Fields of VV; a missing one is empty, as old units leave some out."""
    return Identity(*(fields.get(key, "") for key in ("VEND", "PROD", "FIRM", "PROT", "SERI")))


def parse_parameters(fields: dict[str, str]) -> Parameters:
    """Fields of PP.

    Raises:
        ProtocolError: a field is missing, no number, or the geometry is impossible.
    """
    try:
        numbers = [int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")]
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"SCIP: PP has no number for {error}") from error
    found = Parameters(fields.get("MODL", ""), *numbers)
    sound = (
        0 <= found.least_mm < found.greatest_mm
        and 0 <= found.first_step < found.last_step < found.steps_per_turn
        and found.rpm > 0
    )
    if not sound:
        raise ProtocolError(f"SCIP: PP tells an impossible geometry: {found}")
    return found


def parse_state(fields: dict[str, str]) -> InternalState:
    """Fields of II.

    Raises:
        ProtocolError: no hexadecimal TIME.
    """
    try:
        counter = int(fields["TIME"], 16)
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"SCIP: II has no hexadecimal TIME: {error}") from error
    return InternalState(
        laser_on=fields.get("LASR", "") == "ON",
        speed=fields.get("SCSP", ""),
        mode=fields.get("MESM", ""),
        counter=counter,
        status=fields.get("STAT", ""),
    )
