"""Rows of ``devices_today``: modules with a table ``ROWS`` of functions by device, and the shared module ``kit``."""
