"""The far side of ``station.py``: a robot that only publishes."""
