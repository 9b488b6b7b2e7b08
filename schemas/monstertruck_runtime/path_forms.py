"""Names of the forms in which paths are written; light, for the command line."""

from enum import StrEnum


class PathForm(StrEnum):
    """Forms in which paths are written."""

    CSV = "csv"
    F1TENTH = "f1tenth"
    TUM = "tum"
    CENTRELINE = "centreline"
    NAV2 = "nav2"
