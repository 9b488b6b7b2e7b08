"""Counterpart of ``station.py``: a robot that only publishes."""
