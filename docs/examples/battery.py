"""Plots the battery's voltage for some seconds: docs/examples/battery.py [ENDPOINT [SECONDS]]; needs matplotlib."""

import sys

import matplotlib.pyplot as plt

from monstertruck_runtime.truck import Truck
from monstertruck_schemas.topics import BATTERY

endpoint = sys.argv[1] if sys.argv[1:] else "tcp/127.0.0.1:7447"
seconds = float(sys.argv[2]) if sys.argv[2:] else 10.0

times, volts = [], []
with Truck("truck", endpoint) as truck, truck.stream(BATTERY) as messages:
    for battery in messages:
        times.append(battery.stamp / 1e9)
        volts.append(battery.raw_voltage)
        if times[-1] - times[0] > seconds:
            break

plt.plot([t - times[0] for t in times], volts)
plt.xlabel("s")
plt.ylabel("battery, V")
plt.savefig("battery.png")
