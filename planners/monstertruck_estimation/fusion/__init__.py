"""Odometry fused from wheels, compass with tilt, and the motion between scans.

``filter`` holds the equations of the filter, ``compass_gate`` accepts or rejects headings, ``slip`` detects wheel slip,
``estimator`` keeps measurements in order and combines them, ``service`` subscribes and publishes.
"""
