"""Parts of ``durability.py``: what is killed, and the disk that forgets.

A subject is something that is written and acknowledged: recordings, maps, settings, points, missions, users,
calibration, latch. It is a module here with a ``SUBJECT`` (see ``subject.py``), and a row of ``SUBJECTS`` in
``deaths.py``; the benchmark kills its writer, cuts its power, and asks its ``check`` what is wrong.

``deaths.py``: kills and power cuts. ``disk.py`` and ``trace.c``: what a disk may hold after a power cut.
"""
