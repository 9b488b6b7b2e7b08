"""The page's part of ``estop.py``."""
