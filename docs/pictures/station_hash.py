"""Hash of the page that the pictures of the station show."""

import hashlib
from pathlib import Path

HERE = Path(__file__).parent
HASH = HERE / "station.sha256"
PAGE = HERE.parents[1] / "monstertruckd" / "station" / "page"


def page_hash() -> str:
    """SHA-256 of the page's files with their names."""
    digest = hashlib.sha256()
    for file in sorted(path for path in PAGE.rglob("*") if path.is_file()):
        digest.update(file.relative_to(PAGE).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()
