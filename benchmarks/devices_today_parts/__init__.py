"""Rows of ``devices_today``: modules with a table ``ROWS`` of functions by device; ``kit`` is what they share."""
