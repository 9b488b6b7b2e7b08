"""Users of a page served to other machines: names, roles, and passwords as scrypt hashes (RFC 7914)."""

import asyncio
import base64
import binascii
import hashlib
import hmac
import ipaddress
import logging
import re
import secrets
import stat
from collections import OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from monstertruck_runtime.errors import InputError, NotFoundError, NotPermittedError, TruckError
from monstertruck_runtime.small_files import make_folder, remove_leftovers, replace_file
from monstertruck_runtime.threads import in_thread
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import SOURCE_NAME

WRONG_PASSWORD_PAUSE: Final = 1.0
"""Delay after a wrong password (s); attempts are processed in sequence."""
log = logging.getLogger(__name__)

COST: Final = {"n": 2**14, "r": 8, "p": 1}
"""Parameters of scrypt: 16 MB and about 50 ms per attempt."""
LENGTH: Final = 32
HASH: Final = re.compile(rf"[0-9a-f]{{{2 * LENGTH}}}:[0-9a-f]{{{2 * LENGTH}}}")
NO_HASH: Final = ":".join(("00" * LENGTH,) * 2)
"""Hash compared for unknown names, so that they take as long as known names."""


@dataclass(frozen=True, slots=True)
class StationUser:
    """User of a page."""

    name: str
    role: AccessRole
    proof: str = field(default="", repr=False)
    """Hash of the password at login."""

    def may(self, needed: AccessRole) -> bool:
        """Return whether the user's role covers ``needed``."""
        return self.role.covers(needed)


LOCAL: Final = StationUser("", AccessRole.ENGINEER)
"""User at this machine: the page has no login there, like the other commands."""


class StationUsers:
    """Current users in a file.

    Args:
        file: file with the users.

    Raises:
        NotFoundError: the file does not exist.
        NotPermittedError: other accounts may read the file.
        InputError: the file is not a users file.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._version = _version(file)
        self._reported: object = self._version
        """Damaged version that was reported."""
        self._rows = _read(file)
        self._known: OrderedDict[bytes, StationUser] = OrderedDict()
        """Users of valid headers, by hash of the header: a page requests a dozen files."""
        self._secret = secrets.token_bytes(LENGTH)
        self._turns: dict[str, tuple[asyncio.Lock, int]] = {}
        """Lock and number of waiting attempts of each address."""
        self._hashing = asyncio.Semaphore(2)  # maximum number of concurrent hash computations

    async def refresh(self) -> bool:
        """Read the file again if it has changed; return whether the users have changed.

        If the file cannot be read or contains no user, the error is reported, the read is retried and the users stay
        unchanged: a mistake in an editor must not take the emergency stop away from any user.
        """
        version = await in_thread(lambda: _version(self._file))
        if version == self._version:
            return False
        try:
            rows = await in_thread(lambda: _read(self._file))
        except (TruckError, OSError) as error:
            if version != self._reported:
                log.error("the user list is unchanged: %s", error)
            self._reported = version
            return False
        self._version = self._reported = version
        if rows == self._rows:
            return False
        self._rows = rows
        self._known = OrderedDict((mark, user) for mark, user in self._known.items() if self.stands(user))
        log.info("%s was read again: %d users", self._file, len(rows))
        return True

    def stands(self, user: StationUser) -> bool:
        """Return whether a logged-in user still exists with the same role and password."""
        return self._rows.get(user.name) == (user.role, user.proof)

    async def who(self, header: str | None, address: str = "") -> StationUser | None:
        """Return the user of a Basic ``Authorization`` header (RFC 7617); None for an invalid login.

        Attempts of one address, or IPv6 network, are checked in sequence: guessing delays no user elsewhere.
        """
        credentials = _credentials(header)
        if credentials is None:
            return None
        mark = hmac.digest(self._secret, "\0".join(credentials).encode(), "sha256")
        if mark not in self._known:
            name, password = credentials
            role, kept = self._rows.get(name, (AccessRole.OBSERVER, NO_HASH))
            user, network = StationUser(name, role, kept), network_of(address)
            # Maximum number of waiting attempts of one address; further attempts fail at once.
            if self._turns.get(network, (None, 0))[1] >= 16:
                return None
            async with self._turn(network):
                async with self._hashing:
                    right = await in_thread(lambda: _matches(password, kept))
                if not right or not self.stands(user):
                    await asyncio.sleep(WRONG_PASSWORD_PAUSE)
                    return None
            self._known[mark] = user
            while len(self._known) > 256:
                self._known.popitem(last=False)
            return user
        return self._known[mark]

    @asynccontextmanager
    async def _turn(self, address: str) -> AsyncIterator[None]:
        lock, waiting = self._turns.get(address, (asyncio.Lock(), 0))
        self._turns[address] = lock, waiting + 1
        try:
            async with lock:
                yield
        finally:
            waiting = self._turns[address][1] - 1
            if waiting:
                self._turns[address] = lock, waiting
            else:
                del self._turns[address]


def network_of(address: str) -> str:
    """Return the common key of one site's attempts: its address, or its 64-bit network for IPv6."""
    with suppress(ValueError):
        found = ipaddress.ip_address(address.partition("%")[0])
        if found.version == 6 and found.ipv4_mapped is None:
            return str(ipaddress.ip_network((found, 64), strict=False))
    return address


def _version(file: Path) -> tuple[int, ...] | None:
    """Return a value that changes whenever a file is written; None if the file does not exist."""
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size, found.st_mode


def _read(file: Path) -> dict[str, tuple[AccessRole, str]]:
    """Read role and password hash by name.

    Raises:
        NotFoundError: the file does not exist.
        NotPermittedError: others may read the file.
        InputError: the file is not a users file.
    """
    if not file.is_file():
        raise NotFoundError(
            f"{file}: does not exist; add a user with monstertruckd station --add-user NAME --users {file}"
        )
    if file.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise NotPermittedError(f"{file}: other users may read it; expected mode 600 (chmod 600 {file})")
    if not (rows := _rows(file)):
        raise InputError(f"{file}: expected at least one user")
    return {name: _row(file, name, value) for name, value in rows.items()}


def add_user(file: Path, name: str, role: AccessRole, password: str) -> None:
    """Add a user to a file, or change one.

    Raises:
        InputError: the name is not valid in a key, or the password is too short.
    """
    if not SOURCE_NAME.fullmatch(name) or ":" in name or len(name) > 24:
        raise InputError(f"user {name!r}: expected up to 24 letters, digits and . _ - @")
    shortest = 8  # minimum length of a password (characters)
    if len(password) < shortest:
        raise InputError(f"password of {name}: expected at least {shortest} characters")
    rows = _rows(file) if file.exists() else {}
    rows[name] = {"role": role.value, "password": hash_of(password, secrets.token_bytes(LENGTH))}
    make_folder(file.parent)
    remove_leftovers(file.parent)
    if file.exists():
        file.chmod(0o600)
    replace_file(file, yaml_text(rows), 0o600)


def hash_of(password: str, salt: bytes) -> str:
    """Return salt and scrypt hash, hexadecimal, separated by a colon."""
    return f"{salt.hex()}:{hashlib.scrypt(password.encode(), salt=salt, dklen=LENGTH, **COST).hex()}"


def _matches(password: str, kept: str) -> bool:
    return hmac.compare_digest(hash_of(password, bytes.fromhex(kept.partition(":")[0])), kept)


def _rows(file: Path) -> dict[str, Any]:
    """Read the users of a file by name.

    Raises:
        InputError: the file is not a users file.
    """
    rows = read_yaml(file) or {}
    if not isinstance(rows, dict) or not all(isinstance(name, str) for name in rows):
        raise InputError(f"{file}: expected users by name, each with role and password")
    return rows


def _row(file: Path, name: str, value: Any) -> tuple[AccessRole, str]:
    try:
        role, kept = AccessRole(value["role"]), str(value["password"])
        if not HASH.fullmatch(kept):
            raise ValueError(kept)
    except (ValueError, KeyError, TypeError):
        roles = ", ".join(AccessRole)
        raise InputError(f"{file}: {name}: expected a role ({roles}) and a password hash") from None
    return role, kept


def _credentials(header: str | None) -> tuple[str, str] | None:
    scheme, _, rest = (header or "").partition(" ")
    if scheme.lower() != "basic" or len(rest) > 1024:
        return None
    try:
        name, colon, password = base64.b64decode(rest, validate=True).decode().partition(":")
    except (binascii.Error, UnicodeDecodeError):
        return None
    return (name, password) if colon else None
