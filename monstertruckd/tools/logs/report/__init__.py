"""``log report``: a run on one HTML page that needs nothing but itself."""

from monstertruckd.tools.logs.report.page import Report, report

__all__ = ["Report", "report"]
