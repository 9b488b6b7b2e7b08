"""Reading logs: iteration, summary, repair and export. Works on unfinished and damaged files as far as they go."""

from monstertruckd.logs.export import export_csv, export_npz
from monstertruckd.logs.info import info
from monstertruckd.logs.reader import LogMessage, LogReader, open_log
from monstertruckd.logs.recover import Recovery, recover, recover_directory

__all__ = [
    "LogMessage",
    "LogReader",
    "Recovery",
    "export_csv",
    "export_npz",
    "info",
    "open_log",
    "recover",
    "recover_directory",
]
