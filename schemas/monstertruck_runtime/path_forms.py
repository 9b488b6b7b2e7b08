"""Names of the path file formats, without heavy imports, for the command line."""

from enum import StrEnum


class PathForm(StrEnum):
    """File formats of paths."""

    CSV = "csv"
    F1TENTH = "f1tenth"
    TUM = "tum"
    CENTRELINE = "centreline"
    NAV2 = "nav2"
