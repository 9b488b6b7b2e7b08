"""Odometry from every sensor there is: wheels, compass with tilt, and the motion between scans.

``beliefs`` holds the filter's equations, ``history`` lets measurements come late, ``heading`` gates the compass,
``slip`` watches the wheels, ``estimator`` ties them together and ``service`` gives them the bus.
"""
