"""``log report``: a run on one self-contained HTML page."""

from monstertruckd.tools.logs.report.page import RunReport, report

__all__ = ["RunReport", "report"]
