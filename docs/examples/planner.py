"""A planner of one's own: a curve to a point ahead, sent as a path: docs/examples/planner.py ENDPOINT AHEAD LEFT."""

import sys

import numpy as np

from monstertruck_runtime.truck import Truck
from monstertruck_schemas.plan import Path
from monstertruck_schemas.topics import ODOMETRY

endpoint, ahead, left = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])

with Truck("truck", endpoint) as truck:
    start = truck.get(ODOMETRY)
    t = np.linspace(0.0, 1.0, 50)
    x, y = ahead * t, left * (3 * t**2 - 2 * t**3)  # straight at both ends
    yaw = np.arctan2(left * 6 * (t - t**2), ahead)
    c, s = np.cos(start.pose.yaw), np.sin(start.pose.yaw)
    poses = np.stack([start.pose.x + c * x - s * y, start.pose.y + s * x + c * y, start.pose.yaw + yaw], axis=1)
    path = Path(
        stamp=0, received=0, seq=0, frame=start.frame, name="curve", poses=poses.ravel(), directions=np.ones(50)
    )
    print(truck.follow(path, arm=True).text)
