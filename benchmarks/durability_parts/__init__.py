"""Parts of ``durability.py``: killed writers, and the disk that loses unsynced data.

A subject is data that is written and acknowledged: recordings, maps, settings, points, missions, users, calibration,
latch. It is a module here with a ``SUBJECT`` (see ``subject.py``), and a row of ``SUBJECTS`` in ``deaths.py``; the
benchmark kills its writer, cuts its power, and then calls its ``check``.

``deaths.py``: kills and power cuts. ``disk.py`` and ``trace.c``: possible content of a disk after a power cut.
"""
