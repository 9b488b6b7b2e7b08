"""Requests and structures against the kernel's header (x86-64), compiled once by hand."""

import os
import struct

import pytest

from monstertruck_drivers.webcam import protocol as v4l2
from monstertruck_drivers.webcam.source import Mode
from monstertruck_drivers.webcam.v4l2_source import Kernel

LP64 = struct.calcsize("@P") == 8


@pytest.mark.skipif(not LP64, reason="numbers of 64-bit machines")
@pytest.mark.parametrize(
    ("request_number", "expected"),
    [
        (v4l2.QUERYCAP, 0x80685600),
        (v4l2.ENUM_FMT, 0xC0405602),
        (v4l2.S_FMT, 0xC0D05605),
        (v4l2.REQBUFS, 0xC0145608),
        (v4l2.QUERYBUF, 0xC0585609),
        (v4l2.QBUF, 0xC058560F),
        (v4l2.DQBUF, 0xC0585611),
        (v4l2.STREAMON, 0x40045612),
        (v4l2.STREAMOFF, 0x40045613),
        (v4l2.S_PARM, 0xC0CC5616),
        (v4l2.ENUM_FRAMESIZES, 0xC02C564A),
        (v4l2.ENUM_FRAMEINTERVALS, 0xC034564B),
    ],
)
def test_request_numbers(request_number: int, expected: int):
    assert request_number == expected


@pytest.mark.skipif(not LP64, reason="offsets of 64-bit machines")
def test_offsets_of_the_fields_that_are_used():
    buffer = bytearray(v4l2.BUFFER.size)
    struct.pack_into("=I", buffer, 0, 3)  # index
    struct.pack_into("=I", buffer, 8, 1234)  # bytesused
    struct.pack_into("=I", buffer, 12, v4l2.TIMESTAMP_MONOTONIC | v4l2.FLAG_ERROR)
    struct.pack_into("=qq", buffer, 24, 7, 654321)  # timestamp
    struct.pack_into("=I", buffer, 56, 99)  # sequence
    struct.pack_into("=I", buffer, 64, 0x3000)  # m.offset
    struct.pack_into("=I", buffer, 72, 65536)  # length
    filled = v4l2.Filled.unpack(buffer)
    assert (filled.index, filled.used, filled.sequence) == (3, 1234, 99)
    assert filled.stamp == 7_654_321_000
    assert (filled.offset, filled.length) == (0x3000, 65536)
    asked = v4l2.format_request(Mode(640, 480, 15.0))
    assert len(asked) == 208
    assert struct.unpack_from("=III4s", asked, 0)[0] == 1
    assert struct.unpack_from("=II4s", asked, 8) == (640, 480, b"MJPG")
    rate = v4l2.rate_request(7.5)
    assert struct.unpack_from("=II", rate, 12) == (1000, 7500)
    assert struct.unpack_from("=II", v4l2.buffer(2), 0) == (2, 1)
    assert struct.unpack_from("=I", v4l2.buffer(2), 60) == (v4l2.MMAP,)


def test_a_stamp_of_another_clock_is_none():
    buffer = v4l2.buffer(0)
    assert v4l2.Filled.unpack(buffer).stamp is None


def test_the_nodes_own_capabilities_go_before_the_devices():
    whole = v4l2.CAP_CAPTURE | v4l2.CAP_STREAMING
    data = v4l2.CAPABILITY.pack(b"uvcvideo", b"C905\0rest", b"usb-1", 0, whole | v4l2.CAP_DEVICE_CAPS, 0, 0, 0, 0)
    assert not v4l2.Capability.unpack(data).captures
    data = v4l2.CAPABILITY.pack(b"uvcvideo", b"C905\0rest", b"usb-1", 0, whole, 0, 0, 0, 0)
    capability = v4l2.Capability.unpack(data)
    assert capability.captures
    assert (capability.driver, capability.card, capability.bus) == ("uvcvideo", "C905", "usb-1")


def test_rates():
    assert v4l2.rate_granted(v4l2.rate_request(15.0), 1.0) == 15.0
    assert v4l2.rate_granted(bytes(v4l2.STREAM_PARAMETERS.size), 12.5) == 12.5


def test_names_of_pixel_formats():
    assert v4l2.fourcc(v4l2.MJPG) == "MJPG"
    assert v4l2.fourcc(int.from_bytes(b"Y8  ", "little")) == "Y8"


def test_the_real_kernel(tmp_path):
    """What of it can be tried without a camera: a regular file is mapped, and refuses requests."""
    kernel = Kernel()
    for name in ("video10", "video2"):
        (tmp_path / name).write_bytes(b"0123456789")
    nodes = kernel.nodes(str(tmp_path / "video*"))
    assert nodes == [str(tmp_path / "video2"), str(tmp_path / "video10")]
    assert kernel.nodes(str(tmp_path / "none*")) == []
    fd = kernel.open(nodes[0])
    assert not os.get_blocking(fd)
    with pytest.raises(OSError, match="ioctl"):
        kernel.ioctl(fd, v4l2.QUERYCAP, bytearray(v4l2.CAPABILITY.size))
    memory = kernel.map(fd, 10, 0)
    assert memory[2:5] == b"234"
    memory.close()
    kernel.close(fd)
