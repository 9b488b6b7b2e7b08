"""Client pyrplidarsdk (MIT licence), around the maker's own library, in a process of its own: it keeps the interpreter.

Arguments: port, baud rate, seconds. Prints angles, rad, and ranges, m, of one scan as JSON.
"""

import json
import sys
import time

import pyrplidarsdk


def scan(port: str, baud: int, seconds: float) -> list[list[float]]:
    """Angles and ranges of the newest scan after so many seconds."""
    client = pyrplidarsdk.RplidarDriver(port=port, baudrate=baud)
    if not client.connect():
        raise SystemExit("not connected")
    try:
        if client.get_health().status or not client.start_scan():
            raise SystemExit("no scan")
        until = time.monotonic() + seconds
        found = None
        while time.monotonic() < until or found is None:
            found = client.get_scan_data() or found
        return [list(found[0]), list(found[1])]
    finally:
        client.stop_scan()
        client.disconnect()


if __name__ == "__main__":
    print(json.dumps(scan(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))))
