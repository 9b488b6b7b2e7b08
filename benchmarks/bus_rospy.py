"""The two ends of ``bus.py`` in rospy: scans to and fro as ``sensor_msgs/LaserScan``. Runs in the system's Python.

    python3 bus_rospy.py ping|echo

``ping`` reads lines ``COUNT RATE`` (rate 0: one after the other) from its standard input and answers with a JSON list
of round trips in ns.
"""

import json
import random
import sys
import threading
import time

import rospy
from sensor_msgs.msg import LaserScan

BEAMS = 682
TIMEOUT = 5.0


def main() -> None:
    """Run one end until standard input ends."""
    me = sys.argv[1]
    other = {"ping": "echo", "echo": "ping"}[me]
    rospy.init_node(me, disable_signals=True)
    out = rospy.Publisher(f"/{me}/scan", LaserScan, queue_size=10, tcp_nodelay=True)
    arrived = threading.Semaphore(0)
    receive = out.publish if me == "echo" else lambda _: arrived.release()
    rospy.Subscriber(f"/{other}/scan", LaserScan, receive, queue_size=10, tcp_nodelay=True)
    while out.get_num_connections() == 0:
        time.sleep(0.05)
    if me == "echo":
        rospy.spin()
    time.sleep(1.0)
    print("ready", flush=True)
    ranges = [random.uniform(0.1, 5.5) for _ in range(BEAMS)]
    for line in sys.stdin:
        count, rate = int(line.split()[0]), float(line.split()[1])
        times = []
        due = time.monotonic()
        for number in range(count):
            if rate:
                due += 1 / rate
                time.sleep(max(0.0, due - time.monotonic()))
            begin = time.perf_counter_ns()
            scan = LaserScan(angle_min=-2.086, angle_max=2.086, angle_increment=0.00613, range_max=5.6, ranges=ranges)
            scan.header.seq, scan.header.stamp, scan.header.frame_id = number, rospy.Time.now(), "lidar"
            out.publish(scan)
            assert arrived.acquire(timeout=TIMEOUT)
            times.append(time.perf_counter_ns() - begin)
        print(json.dumps(times), flush=True)


if __name__ == "__main__":
    main()
