"""VV, PP and II of the captured sensor, and what else those fields state."""

import math

import pytest

from monstertruck_drivers.hokuyo_urg.protocol import (
    SCIP1_PARAMETERS,
    build_fields,
    line_sum,
    parse_fields,
    parse_identity,
    parse_parameters,
    parse_state,
)
from monstertruck_runtime.errors import ProtocolError

VV = [
    b"VEND:Hokuyo Automatic Co.,Ltd.;[",
    b"PROD:SOKUIKI Sensor URG-04LX;[",
    b"FIRM:3.1.04(02/Aug./2007);a",
    b"PROT:SCIP 2.0;N",
    b"SERI:H0706400;F",
]
PP = [
    b"MODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N",
    b"DMIN:20;4",
    b"DMAX:5600;_",
    b"ARES:1024;\\",
    b"AMIN:44;7",
    b"AMAX:725;o",
    b"AFRT:384;6",
    b"SCAN:600;e",
]
II = [
    b"LASR:ON;9",
    b"SCSP:Initial(600[rpm])<-Default setting by user;A",
    b"MESM:CLASSIC;^",
    b"SBPS:19200[bps]<-Default setting by user;A",
    b"TIME:6A5404;]",
    b"STAT:Sensor works well.;8",
]


def test_captured_identity():
    identity = parse_identity(parse_fields(VV))
    assert identity.product == "SOKUIKI Sensor URG-04LX"
    assert identity.firmware == "3.1.04(02/Aug./2007)"
    assert identity.protocol == "SCIP 2.0"
    assert identity.serial == "H0706400"


def test_captured_parameters():
    parameters = parse_parameters(parse_fields(PP))
    assert parameters.model == "URG-04LX(Hokuyo Automatic Co.,Ltd.)"
    assert (parameters.least_mm, parameters.greatest_mm) == (20, 5600)
    assert (parameters.first_step, parameters.last_step, parameters.front_step) == (44, 725, 384)
    assert parameters.period == pytest.approx(0.1)
    assert parameters.step_time == pytest.approx(97.66e-6, rel=1e-4)
    span = parameters.angle(parameters.last_step) - parameters.angle(parameters.first_step)
    assert math.degrees(span) == pytest.approx(239.4, abs=0.05)


def test_captured_state():
    state = parse_state(parse_fields(II))
    assert state.laser_on
    assert state.mode == "CLASSIC"
    assert state.counter == 0x6A5404 == 6_968_324
    assert state.status == "Sensor works well."


def test_built_lines_are_the_captured_ones():
    for lines in (VV, PP, II):
        assert build_fields(parse_fields(lines)) == lines


def test_a_sum_that_counts_the_semicolon_is_accepted():
    text = b"AMIN:44;"
    assert parse_fields([text + bytes((line_sum(text),))]) == {"AMIN": "44"}


def test_a_sum_that_leaves_the_note_out_is_accepted():
    assert parse_fields([b"SCSP:Initial(600[rpm])<-Default setting by user;["])["SCSP"].startswith("Initial")


def test_only_seri_may_lie_about_its_sum():
    assert parse_fields([b"SERI:H0706400;G"]) == {"SERI": "H0706400"}
    with pytest.raises(ProtocolError, match="bad checksum"):
        parse_fields([b"AMIN:45;7"])


@pytest.mark.parametrize("line", [b"", b"rubbish", b"TOOLONG:1;x"])
def test_lines_of_another_form(line: bytes):
    with pytest.raises(ProtocolError, match="KEY:value"):
        parse_fields([line])


def test_scip1_fields_have_no_sums():
    assert parse_fields([b"VEND:Hokuyo;", b"FIRM:2.2.5"], sums=False) == {"VEND": "Hokuyo", "FIRM": "2.2.5"}
    assert parse_identity({"VEND": "Hokuyo"}).serial == ""


@pytest.mark.parametrize(
    ("key", "value"),
    [("AMIN", "800"), ("AMAX", "1024"), ("SCAN", "0"), ("DMAX", "10"), ("ARES", "x"), ("DMIN", None)],
)
def test_impossible_geometry_is_refused(key: str, value: str | None):
    fields = parse_fields(PP)
    if value is None:
        del fields[key]
    else:
        fields[key] = value
    with pytest.raises(ProtocolError, match="PP"):
        parse_parameters(fields)


@pytest.mark.parametrize("fields", [{}, {"TIME": "xyz"}])
def test_a_state_without_time_is_refused(fields: dict[str, str]):
    with pytest.raises(ProtocolError, match="TIME"):
        parse_state(fields)


def test_old_units_measure_what_their_encoding_holds():
    assert SCIP1_PARAMETERS.greatest_mm == 4095
