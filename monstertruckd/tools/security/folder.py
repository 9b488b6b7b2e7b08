"""The folder of an authority: its key, its stations, and the files to be copied to the robot and to each station.

::

    authority.pem authority.key     the authority; the key stays here
    register.yaml                   robot, addresses, stations with role and rank
    issuers/NAME.pem .key           one per station; the keys stay here
    robot/                          for the robot: zenoh.yaml, its certificate and key, admitted issuers
    stations/NAME/                  for the station: its certificate and key, the authority's certificate
    router.pem                      authority of the fleet's router, if there is one
"""

import fcntl
import ipaddress
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self, TypeVar

from pydantic import Field, ValidationError, field_validator, model_validator

from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.outside import contents, contents_if_present
from monstertruck_runtime.small_files import MEGABYTE, make_folder, remove_file, remove_leftovers, replace_file
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_schemas.base import Name, Schema, first_mistake
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruckd.bus.zenoh_config import OWNER_NAME, OwnerName, TlsConfig, ZenohConfig
from monstertruckd.config.load import FILE_VERSION
from monstertruckd.config.truck import ROBOT
from monstertruckd.tools.security.certificates import (
    DAY,
    Certificate,
    began,
    issue,
    load,
    new_authority,
    new_issuer,
    read_certificate,
    seconds_left,
)

AUTHORITY_DAYS: Final = 3650
ROBOT_DAYS: Final = 825
PORT: Final = 7447
ROUTER_FILE: Final = "router.pem"
"""Certificate of the authority of the fleet's router, absent without a router."""
PLACE: Final = Path("/etc/monstertruckd/security")
"""Folder of the robot's security files, on the robot."""

WRITTEN: Final = "# Written by `monstertruckd security`; include it in the robot's configuration.\n"
FIRST: Final[dict[str, Any]] = {"robot": ROBOT, "addresses": ("localhost", "127.0.0.1")}
"""Defaults of an authority."""
HOST_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")

S = TypeVar("S", bound=Schema)
Rank = Literal[Role.GAMEPAD, Role.KEYBOARD, Role.STATION]


class CertifiedStation(Schema):
    """One admitted certificate."""

    role: AccessRole
    rank: Rank = Role.STATION


class TrustedRouter(Schema):
    """Router of the fleet that the robot connects to."""

    name: OwnerName
    """Common name of the router's certificate."""
    endpoint: str


class CertificateRegister(Schema):
    """Register of an authority."""

    robot: Name
    addresses: tuple[str, ...] = Field(min_length=1)
    """Addresses and host names of the robot."""
    place: Path = PLACE
    """Folder of the robot's security files, on the robot."""
    stations: dict[OwnerName, CertifiedStation] = {}
    router: TrustedRouter | None = None

    @field_validator("addresses")
    @classmethod
    def _dialled(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        for address in given:
            require_address(address)
        return given

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.router is not None and self.router.name in self.stations:
            raise ValueError(
                f"{self.router.name}: is the name of the fleet's router: choose another name for the station"
            )
        return self

    def of_role(self, *roles: AccessRole) -> tuple[str, ...]:
        """Return the names of stations with one of these roles."""
        return tuple(name for name, station in self.stations.items() if station.role in roles)


CERTIFICATE: Final = "a certificate"
"""Expected content of a file in error messages."""


@dataclass(frozen=True, slots=True)
class Expiry:
    """Expiry of a certificate in the folder."""

    name: str
    role: str
    rank: str
    days: int | None
    """Time until the certificate expires; negative after its expiry; None: its file is not in the folder."""


class Folder:
    """An authority's folder.

    Args:
        path: path of the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.robot = path / "robot"

    def register(self) -> CertificateRegister:
        """The register of certified names.

        Raises:
            NotFoundError: there is no authority here.
            InputError: the register is damaged.
        """
        file = self.path / "register.yaml"
        if not file.is_file():
            raise NotFoundError(f"{self.path}: contains no authority; create one with monstertruckd security init")
        return _validated(CertificateRegister, read_yaml(file), file)

    def init(
        self,
        robot: str | None,
        addresses: tuple[str, ...] | None,
        place: Path | None,
        now: int,
        days: int = ROBOT_DAYS,
    ) -> bool:
        """Create an authority, or renew the robot's certificate; return True if there was none.

        Args:
            robot: name of the robot; None, here and below, keeps the value; initially truck.
            addresses: addresses of the robot, for stations; initially those of this computer.
            place: folder of the robot's files on the robot.
            now: real time (s).
            days: validity of the robot's certificate.

        Raises:
            InputError: a name or number of days is invalid, or the register of an authority with stations is missing.
            OSError: the folder cannot be written.
        """
        named = {"robot": robot, "addresses": addresses, "place": place}
        given = {name: value for name, value in named.items() if value is not None}
        _validated(CertificateRegister, FIRST | given, self.path)
        if days > AUTHORITY_DAYS:
            raise InputError(f"{days} days: expected at most {AUTHORITY_DAYS}, the lifetime of the authority")
        make_folder(self.path, 0o700)
        with self._alone():
            new = not (self.path / "register.yaml").exists()
            if new and (names := sorted(file.stem for file in self.path.glob("issuers/*.pem"))):
                raise InputError(
                    f"{self.path}: register.yaml is missing among certificates of {', '.join(names)}: restore it, "
                    "or remove the folder issuers to start again without them"
                )
            before = FIRST if new else self.register().model_dump()
            register = _validated(CertificateRegister, before | given, self.path)
            # A start that was broken off may have left one that is good.
            if new and not self._files("authority")[0].exists():
                new_authority(f"Authority of {register.robot}", now, AUTHORITY_DAYS).save(*self._files("authority"))
            make_folder(self.robot, 0o700)
            authority = self.authority()
            _require_time(authority, now, days)
            issue(authority, register.robot, now, days * DAY, server=register.addresses).save(
                self.robot / "robot.pem", self.robot / "robot.key"
            )
            self._write(register)
        return new

    def add(self, name: str, role: AccessRole | None, rank: Role | None, now: int, days: int = 365) -> bool:
        """Certify a station, or renew its certificate; return True if the robot must be restarted to admit it.

        Args:
            name: common name, and the source of its requests.
            role: its role; None keeps it, initially pilot.
            rank: its maximum priority; None keeps it, initially station.
            now: real time (s).
            days: validity of its certificate.

        Raises:
            InputError: a name, rank or number of days is invalid.
            NotFoundError: there is no authority here.
        """
        if not OWNER_NAME.fullmatch(name):
            raise InputError(
                f"{name!r}: expected a name of up to 32 letters, digits and . _ - @, not starting with . or @"
            )
        with self._alone():
            before = self.register()
            known = before.stations.get(name, CertifiedStation(role=AccessRole.PILOT))
            made = {**before.stations, name: {"role": role or known.role, "rank": rank or known.rank}}
            register = _validated(CertificateRegister, before.model_dump() | {"stations": made}, name)
            authority = self.authority()
            _require_time(authority, now, days)
            files = self._files(f"issuers/{name}")
            make_folder(files[0].parent, 0o700)
            if not files[0].exists():  # written after its key
                new_issuer(authority, f"Issuer of {name}", now, seconds_left(authority.certificate, now) // DAY).save(
                    *files
                )
            issuer = load(*files)
            target = self.path / "stations" / name
            make_folder(target, 0o700)
            issue(issuer, name, now, days * DAY).save(target / "station.pem", target / "station.key", issuer.pem)
            replace_file(target / "ca.pem", self._trusted())
            return self._write(register)

    def revoke(self, name: str) -> None:
        """Remove a station and its issuer.

        Raises:
            NotFoundError: there is no such station.
        """
        with self._alone():
            register = self.register()
            if name not in register.stations:
                raise NotFoundError(f"no station {name!r}; there are {', '.join(register.stations) or 'none'}")
            stations = {other: station for other, station in register.stations.items() if other != name}
            kept = register.model_copy(update={"stations": stations})
            self._write_robot(kept)
            for file in self._files(f"issuers/{name}"):
                remove_file(file)
            shutil.rmtree(self.path / "stations" / name, ignore_errors=True)
            self._write(kept)  # last, so that an interrupted request can be repeated

    def join(self, name: str, endpoint: str, authority: bytes) -> None:
        """Make the robot connect to a router, and its stations trust it.

        Args:
            name: common name of the router's certificate.
            endpoint: endpoint of the router.
            authority: certificate of the router's authority, PEM.

        Raises:
            InputError: a station has this name.
        """
        with self._alone():
            made = self.register().model_dump() | {"router": {"name": name, "endpoint": endpoint}}
            register = _validated(CertificateRegister, made, name)
            replace_file(self.path / ROUTER_FILE, authority)
            for station in register.stations:
                target = self.path / "stations" / station
                make_folder(target, 0o700)  # it may have been moved to the station
                replace_file(target / "ca.pem", self._trusted())
            self._write(register)

    def authority(self) -> Certificate:
        """The authority.

        Raises:
            InputError: a file is missing or damaged.
        """
        return load(*self._files("authority"))

    def issuer(self, name: str) -> Certificate:
        """Return the issuer of a station's certificate. Raises the same errors as ``authority``."""
        return load(*self._files(f"issuers/{name}"))

    def certificates(self, now: int) -> list[Expiry]:
        """Return all certificates with their remaining days.

        Args:
            now: real time (s).
        """
        register = self.register()
        rows = [
            ("authority", "authority", "", self.path / "authority.pem"),
            (register.robot, "robot", "", self.robot / "robot.pem"),
            *(
                (name, station.role.value, station.rank.value, self.path / "stations" / name / "station.pem")
                for name, station in register.stations.items()
            ),
        ]
        return [
            Expiry(name, role, rank, seconds_left(read_certificate(file), now) // DAY if file.exists() else None)
            for name, role, rank, file in rows
        ]

    def zenoh(self) -> ZenohConfig:
        """The robot's section of the configuration.

        Raises:
            InputError: no pilot or engineer is certified yet.
        """
        return _validated(ZenohConfig, _zenoh(self.register()), self.path)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Lock this folder against other writers, so that no change is lost."""
        try:
            handle = os.open(self.path, os.O_RDONLY)
        except FileNotFoundError:
            self.register()  # reports the missing files
            raise
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            for folder in (self.path, *(path for path in self.path.rglob("*") if path.is_dir())):
                remove_leftovers(folder)
            yield
        finally:
            os.close(handle)

    def _write(self, register: CertificateRegister) -> bool:
        """Update the robot's files, then the register; True if the robot's files have changed."""
        changed = self._write_robot(register)
        replace_file(self.path / "register.yaml", yaml_text(register.model_dump(mode="json")))
        return changed

    def _write_robot(self, register: CertificateRegister) -> bool:
        driving = register.of_role(AccessRole.PILOT, AccessRole.ENGINEER)
        everybody = [*self._issuers(tuple(register.stations)), self._router()]
        files = {
            "stations.pem": b"".join(everybody),
            "pilots.pem": b"".join(self._issuers(driving)),
            "zenoh.yaml": (WRITTEN + yaml_text({"version": FILE_VERSION, "zenoh": _zenoh(register)})).encode(),
        }
        changed = False
        for name, content in files.items():
            file = self.robot / name
            changed |= contents_if_present(file, "a part of the robot's access", MEGABYTE) != content
            replace_file(file, content)
        return changed

    def _issuers(self, names: tuple[str, ...]) -> list[bytes]:
        return [contents(self._files(f"issuers/{name}")[0], CERTIFICATE, MEGABYTE) for name in names]

    def _router(self) -> bytes:
        """Return the certificate of the router's authority; empty without one."""
        return contents_if_present(self.path / ROUTER_FILE, CERTIFICATE, MEGABYTE) or b""

    def _trusted(self) -> bytes:
        """Return the authorities trusted by a station: the robot's and the router's."""
        return contents(self.path / "authority.pem", CERTIFICATE, MEGABYTE) + self._router()

    def _files(self, name: str) -> tuple[Path, Path]:
        return self.path / f"{name}.pem", self.path / f"{name}.key"


def _zenoh(register: CertificateRegister) -> dict[str, Any]:
    """Return the robot's configuration as plain data."""
    place = register.place
    tls: dict[str, Any] = {
        "ca": str(place / "stations.pem"),
        "pilots_ca": str(place / "pilots.pem"),
        "certificate": str(place / "robot.pem"),
        "key": str(place / "robot.key"),
        "pilots": list(register.of_role(AccessRole.PILOT)),
        "observers": list(register.of_role(AccessRole.OBSERVER)),
        "engineers": list(register.of_role(AccessRole.ENGINEER)),
        "ranks": {
            name: station.rank.value for name, station in register.stations.items() if station.rank is not Role.STATION
        },
    }
    router = register.router
    tls["routers"] = [] if router is None else [router.name]
    assert set(tls) == set(TlsConfig.model_fields)
    return {
        "listen": [f"tls/0.0.0.0:{PORT}"],
        "listen_pilots": ["tls/0.0.0.0:7448"],
        "connect": [] if router is None else [router.endpoint],
        "tls": tls,
    }


def require_address(address: str) -> None:
    """Reject an address that stations cannot use.

    Raises:
        ValueError: it is neither an IP address nor a host name.
    """
    try:
        ipaddress.ip_address(address)
    except ValueError:
        if not HOST_NAME.fullmatch(address):
            raise ValueError(f"{address!r}: expected an IP address or a host name (letters, digits, - and .)") from None


def _require_time(authority: Certificate, now: int, days: int) -> None:
    """Reject a validity beyond that of the authority.

    Raises:
        InputError: the authority is not valid yet, as with a wrong clock, or expires earlier.
    """
    early = began(authority.certificate) - now
    if early > 0:
        raise InputError(
            f"the authority becomes valid in {early / DAY:.1f} days: this computer's clock is wrong, or "
            "was when it was created"
        )
    left = seconds_left(authority.certificate, now) // DAY
    if days > left:
        raise InputError(f"{days} days: the authority expires in {left}; create a new one in another folder")


def _validated(model: type[S], data: Any, where: Path | str) -> S:
    try:
        return model.model_validate(data, strict=False)
    except ValidationError as error:
        raise InputError(f"{where}: {first_mistake(error)}") from None
