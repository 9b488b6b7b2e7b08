"""What emulators have in common."""

import sys

from monstertruck_drivers.emulation import ReceivedBytes


def test_a_trail_keeps_the_newest_bytes_and_is_small():
    trail = ReceivedBytes()
    for number in range(1000):
        trail.extend(bytes([number % 256]) * 1000)
    assert len(trail) == ReceivedBytes.KEPT
    assert trail[-1] == 999 % 256
    assert trail.endswith(bytes([999 % 256]) * 1000)
    assert sys.getsizeof(trail) < 3 * ReceivedBytes.KEPT
