"""Parts of ``benchmarks/ros2.py``: independent programs, each a process."""
