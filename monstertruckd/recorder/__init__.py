"""Recorder: MCAP logs of the bus, a black box of every gate trip, reading and repair of logs, and map pictures."""
