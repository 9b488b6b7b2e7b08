"""Recorder: MCAP logs of the bus, a black box for every gate trip, reading and repair of logs, and map pictures."""
