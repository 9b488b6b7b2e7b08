"""Sentences: documented samples, tolerance, and a parser that nothing stops."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_drivers.os4000.protocol import (
    SENTENCE_LIMIT,
    Fields,
    Key,
    Os4000Parser,
    Sentence,
    build,
    checksum,
    frame,
    is_other_format,
    key,
    parse,
    value,
)

SAMPLES = {
    b"$C320.5P0.2R-18.3T19.0*3C": Sentence(320.5, 0.2, -18.3, 19.0),
    b"$C212.4P2.5R-14.0T28.4Mx107977.90My-79422.00Mz173.27Ax0.045Ay-0.245Az0.977*3A": Sentence(
        212.4, 2.5, -14.0, 28.4, field=(107977.9, -79422.0, 173.27), acceleration=(0.045, -0.245, 0.977)
    ),
    b"$C69.6P-0.4R-90.0T27.0*24": Sentence(69.6, -0.4, -90.0, 27.0),
    b"$C69.7P-0.4R-88.4T27.0*28": Sentence(69.7, -0.4, -88.4, 27.0),
    b"$C90.0P-1.2R0.4T24.5Mx212.40My-31.10Mz401.70Ax0.021Ay-0.007Az1.000*38": Sentence(
        90.0, -1.2, 0.4, 24.5, field=(212.4, -31.1, 401.7), acceleration=(0.021, -0.007, 1.0)
    ),
    b"$C0.0P0.0R0.0T20.0*27": Sentence(0.0, 0.0, 0.0, 20.0),
}


@pytest.mark.parametrize("line", SAMPLES)
def test_documented_sentences_in_both_directions(line: bytes):
    assert parse(line) == SAMPLES[line]
    assert build(SAMPLES[line]) == line + b"\r\n"


def test_checksum_vector():
    assert checksum(b"C320.5P0.2R-18.3T19.0") == 0x3C


def test_commands_are_the_documented_bytes():
    assert key(Key.RATE) + value(20) == bytes.fromhex("1B 52 32 30 20")
    assert key(Key.FIELDS) + value(335) == bytes.fromhex("1B 58 33 33 35 20")
    assert key(Key.FORMAT) + value(1) == bytes.fromhex("1B 2A 31 20")
    assert key(Key.RATE) + value(0) == bytes.fromhex("1B 52 30 20")


def test_fields_in_any_order_lengths_and_unusual_numbers():
    sentence = parse(frame("M401.5A.98T+20C7P-.5D1.R3Ax1Ay2Az3").strip())
    assert sentence == Sentence(
        7.0, -0.5, 3.0, 20.0, 1.0, 401.5, None, acceleration_length=0.98, acceleration=(1.0, 2.0, 3.0)
    )
    assert sentence.fields == Fields(1 + 2 + 4 + 8 + 16 + 32 + 128 + 256)


@pytest.mark.parametrize("line", [b"$C1.0P2*E", b"$C1.0P2*0E", b"$C1.0P2*e\r\n"])
def test_a_sum_may_lack_its_leading_zero(line: bytes):
    assert parse(line) == Sentence(1.0, 2.0)


@pytest.mark.parametrize("digits", [b"3c", b"3C"])
def test_a_sum_in_either_case(digits: bytes):
    assert parse(b"$C320.5P0.2R-18.3T19.0*" + digits).heading == 320.5


@pytest.mark.parametrize("text", ["", "nan", "NaN", "-nan", "inf"])
def test_empty_and_nan_like_fields_are_absent(text: str):
    sentence = parse(frame(f"C{text}P1.0R2.0MxMy3.0Mz4.0").strip())
    assert (sentence.heading, sentence.pitch, sentence.roll, sentence.field) == (None, 1.0, 2.0, None)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (b"$C1.0P2.0*00", "checksum"),
        (b"C1.0P2.0*32", r"not \$"),
        (b"$C1.0P2.0", r"not \$"),
        (frame("C1.0Q2.0"), "unknown or repeated field at 'Q2.0'"),
        (frame("C1.0C2.0"), "repeated"),
        (frame("C1.0.5"), "unknown"),
        (frame(""), "empty"),
    ],
)
def test_bad_sentences_are_refused_with_the_reason(line: bytes, text: str):
    with pytest.raises(ValueError, match=text):
        parse(line)


numbers = st.integers(-9999, 9999).map(lambda n: n / 10)
thousandths = st.integers(-9999, 9999).map(lambda n: n / 1000)
sentences = st.builds(
    Sentence,
    heading=st.none() | st.integers(0, 3599).map(lambda n: n / 10),
    pitch=st.none() | numbers,
    roll=st.none() | numbers,
    temperature=numbers,
    depth=st.none() | numbers,
    field_length=st.none() | numbers,
    field=st.none() | st.tuples(numbers, numbers, numbers),
    acceleration_length=st.none() | thousandths,
    acceleration=st.none() | st.tuples(thousandths, thousandths, thousandths),
)


@given(st.lists(sentences, max_size=6), st.integers(1, 50))
@settings(max_examples=100)
def test_what_is_built_is_parsed_however_it_is_cut(items: list[Sentence], cut: int):
    stream = b"".join(build(sentence) for sentence in items)
    parser = Os4000Parser()
    seen = [s for i in range(0, len(stream), cut) for s in parser.feed(stream[i : i + cut])]
    assert seen == items
    assert (parser.good, parser.bad, parser.text) == (len(items), 0, [])


@given(sentences, st.integers(0, 511))
def test_the_mask_chooses_the_fields(sentence: Sentence, mask: int):
    if not sentence.fields & mask:
        return
    assert parse(build(sentence, mask=Fields(mask))).fields == sentence.fields & mask


@given(st.binary(max_size=600), st.integers(1, 64))
@settings(max_examples=100)
def test_no_garbage_blocks_the_parser_and_cutting_changes_nothing(garbage: bytes, cut: int):
    stream = garbage + b"\n" + b"$C1.0P2.0R3.0*" + b"%02X\r\n" % checksum(b"C1.0P2.0R3.0")
    whole, parts = Os4000Parser(), Os4000Parser()
    expected = whole.feed(stream)
    assert [s for i in range(0, len(stream), cut) for s in parts.feed(stream[i : i + cut])] == expected
    assert (whole.good, whole.bad, whole.text) == (parts.good, parts.bad, parts.text)
    assert expected[-1] == Sentence(1.0, 2.0, 3.0)


@given(st.sampled_from(list(SAMPLES)), st.data())
def test_a_flipped_bit_never_passes(line: bytes, data: st.DataObject):
    at = data.draw(st.integers(0, len(line) - 1))
    damaged = bytearray(line)
    damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    try:
        sentence = parse(bytes(damaged))
    except ValueError:
        return
    assert sentence == SAMPLES[line], "only the case of a sum's digit may differ"


def test_a_flood_without_line_ends_is_dropped():
    parser = Os4000Parser()
    assert parser.feed(b"x" * 10_000) == []
    assert parser.bad == 10_000 // (SENTENCE_LIMIT + 1)
    assert len(parser._buffer) <= SENTENCE_LIMIT
    assert parser.feed(b"\n" + build(Sentence(heading=1.0))) == [Sentence(heading=1.0)]


def test_torn_sentences_and_prompts_are_kept_as_text():
    parser = Os4000Parser()
    seen = parser.feed(b"2R-18.3T19.0*3C\r\nCMD E\r\nValue and Enter or Esc$C1.0*" + b"%02X\r\n" % checksum(b"C1.0"))
    assert seen == [Sentence(heading=1.0)]
    assert parser.text == [b"2R-18.3T19.0*3C", b"CMD E", b"Value and Enter or Esc"]
    parser.feed(b"line\n" * 100)
    assert len(parser.text) == 20


@pytest.mark.parametrize(
    ("line", "yes"),
    [
        (b"$OHPR,69.6,-0.4,-90.0*17", True),
        (b"$HCHDT,69.6,T*2C", True),
        (b"69.6,-0.4,-90.0\r", True),
        (b"$C69.6P-0.4R-90.0T27.0*24", False),
        (b"99b", False),
        (b"", False),
        (b"\xff\x00", False),
    ],
)
def test_other_formats_of_the_compass_are_recognised(line: bytes, yes: bool):
    assert is_other_format(line) is yes
