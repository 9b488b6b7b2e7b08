"""Users and groups of a system in a folder, and what they may do to a file."""

import os
import stat
from dataclasses import dataclass
from pathlib import Path

from monstertruck_runtime.small_files import text_of


@dataclass(frozen=True, slots=True)
class Account:
    """A user with all groups."""

    name: str
    uid: int
    groups: dict[str, int]
    """Names and numbers."""

    def may_use(self, file: Path) -> bool:
        """Whether it may read and write the file; for a folder, whether it may put files into it."""
        try:
            status = file.stat()
        except OSError:
            return False
        needed = 0o7 if stat.S_ISDIR(status.st_mode) else 0o6
        return self.uid == 0 or self._allowed(status) & needed == needed

    def may_read(self, file: Path) -> bool:
        """Whether it may read the file; the folders above are not looked at."""
        try:
            return self.uid == 0 or bool(self._allowed(file.stat()) & 0o4)
        except OSError:
            return False

    def _allowed(self, status: os.stat_result) -> int:
        if status.st_uid == self.uid:
            return status.st_mode >> 6 & 0o7
        if status.st_gid in self.groups.values():
            return status.st_mode >> 3 & 0o7
        return status.st_mode & 0o7


def account_of(root: Path, who: str | int) -> Account | None:
    """The user of that name or number in ``root/etc``; None if there is none."""
    users = [line.split(":") for line in (text_of(root / "etc/passwd") or "").splitlines()]
    user = next((u for u in users if len(u) > 3 and who in (u[0], int(u[2]))), None)
    if user is None:
        return None
    name, uid, gid = user[0], int(user[2]), int(user[3])
    groups = {}
    for line in (text_of(root / "etc/group") or "").splitlines():
        group, _, number, members = (*line.split(":"), "", "", "")[:4]
        if number.isdigit() and (int(number) == gid or name in members.split(",")):
            groups[group] = int(number)
    return Account(name, uid, groups)
