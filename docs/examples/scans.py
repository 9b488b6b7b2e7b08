"""Saves scans as a numpy array of ranges, one row each: docs/examples/scans.py [ENDPOINT [COUNT]]."""

import sys
from itertools import islice

import numpy as np

from monstertruck_runtime.truck import Truck
from monstertruck_schemas.topics import SCAN

endpoint = sys.argv[1] if sys.argv[1:] else "tcp/127.0.0.1:7447"
count = int(sys.argv[2]) if sys.argv[2:] else 20

with Truck("truck", endpoint) as truck, truck.stream(SCAN) as scans:
    ranges = np.stack([scan.ranges for scan in islice(scans, count)])

np.save("scans.npy", ranges)
print(f"{len(ranges)} scans of {ranges.shape[1]} beams, nearest {ranges.min():.2f} m")
