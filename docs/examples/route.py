"""Drives to a pose, at once, by way of others: docs/examples/route.py ENDPOINT X,Y,YAW [X,Y ...]."""

import sys

from monstertruck_runtime.truck import Truck

endpoint, goal, *via = sys.argv[1:]
places = [tuple(map(float, place.split(","))) for place in via]

with Truck("truck", endpoint) as truck:
    arrival = truck.goto(*map(float, goal.split(",")), via=places, arm=True)

print(f"{arrival.text}: {arrival.length:.2f} m in {arrival.elapsed:.1f} s")
