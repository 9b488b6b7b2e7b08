"""The folder of an authority: its key, its stations, and the files to be copied to the robot and to each station.

::

    authority.pem authority.key     the authority; the key stays here
    register.yaml                   robot, addresses, stations with role and rank
    issuers/NAME.pem .key           one per station; the keys stay here
    robot/                          to the robot: zenoh.yaml, its certificate and key, whom it lets in
    stations/NAME/                  to the station: its certificate and key, the authority's certificate
    router.pem                      authority of the fleet's router, where there is one
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self, TypeVar

from pydantic import Field, ValidationError, model_validator

from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.small_files import replace_file
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_schemas.base import Schema
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruckd.bus.zenoh_config import OwnerName, TlsConfig, ZenohConfig
from monstertruckd.config.load import VERSION
from monstertruckd.tools.security.certificates import (
    DAY,
    Certificate,
    issue,
    load,
    new_authority,
    new_issuer,
    read_certificate,
    seconds_left,
)

AUTHORITY_DAYS: Final = 3650
ROBOT_DAYS: Final = 825
STATION_DAYS: Final = 365
PORT: Final = 7447
PILOTS_PORT: Final = 7448
ROUTER_FILE: Final = "router.pem"
"""Certificate of the authority of the fleet's router, if there is one."""
PLACE: Final = Path("/etc/monstertruckd/security")
"""Where the robot keeps its files."""

S = TypeVar("S", bound=Schema)
Rank = Literal[Role.GAMEPAD, Role.KEYBOARD, Role.STATION]


class CertifiedStation(Schema):
    """One certificate that is let in."""

    role: AccessRole
    rank: Rank = Role.STATION


class TrustedRouter(Schema):
    """A router of the fleet that the robot dials."""

    name: OwnerName
    """Common name of its certificate."""
    endpoint: str


class CertificateRegister(Schema):
    """What an authority has certified."""

    robot: str
    addresses: tuple[str, ...] = Field(min_length=1)
    """Addresses and host names of the robot."""
    place: Path = PLACE
    """Where the robot keeps its files."""
    stations: dict[OwnerName, CertifiedStation] = {}
    router: TrustedRouter | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.router is not None and self.router.name in self.stations:
            raise ValueError(f"{self.router.name}: is the fleet's router: expected another name for a station")
        return self

    def of_role(self, *roles: AccessRole) -> tuple[str, ...]:
        """Names with one of these roles."""
        return tuple(name for name, station in self.stations.items() if station.role in roles)


@dataclass(frozen=True, slots=True)
class Expiry:
    """A certificate of the folder."""

    name: str
    role: str
    rank: str
    days: int
    """Until it expires; negative = since then."""


class Folder:
    """An authority's folder.

    Args:
        path: of it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.robot = path / "robot"

    def register(self) -> CertificateRegister:
        """What is certified.

        Raises:
            NotFoundError: there is no authority here.
            InputError: the register is damaged.
        """
        file = self.path / "register.yaml"
        if not file.is_file():
            raise NotFoundError(f"{self.path}: no authority here; monstertruckd security init makes one")
        return _validated(CertificateRegister, read_yaml(file), file)

    def init(self, robot: str, addresses: tuple[str, ...], place: Path, now: int, days: int = ROBOT_DAYS) -> bool:
        """Make an authority, or renew the robot's certificate; True if there was none.

        Args:
            robot: its name.
            addresses: what stations dial.
            place: where the robot keeps its files.
            now: real time, s.
            days: until the robot's certificate expires.

        Raises:
            InputError: the names make no sense, or the folder cannot be written.
        """
        new = not (self.path / "register.yaml").exists()
        kept = {} if new else self.register().model_dump(include={"stations", "router"})
        made = {"robot": robot, "addresses": addresses, "place": place, **kept}
        register = _validated(CertificateRegister, made, self.path)
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if new:
            new_authority(f"Authority of {robot}", now, AUTHORITY_DAYS).save(*self._files("authority"))
        self.robot.mkdir(mode=0o700, exist_ok=True)
        authority = self.authority()
        issue(authority, robot, now, days * DAY, server=addresses).save(
            self.robot / "robot.pem", self.robot / "robot.key"
        )
        self._write(register)
        return new

    def add(self, name: str, role: AccessRole, rank: Role, now: int, days: int = STATION_DAYS) -> bool:
        """Certify a station, or renew its certificate; True if the robot must be restarted to know it.

        Args:
            name: common name, and the source of its requests.
            role: what it may do.
            rank: highest priority it may claim.
            now: real time, s.
            days: until its certificate expires.

        Raises:
            InputError: a name or rank that makes no sense.
            NotFoundError: there is no authority here.
        """
        before = self.register()
        made = {**before.stations, name: {"role": role, "rank": rank}}
        register = _validated(CertificateRegister, before.model_dump() | {"stations": made}, name)
        files = self._files(f"issuers/{name}")
        files[0].parent.mkdir(mode=0o700, exist_ok=True)
        if not files[1].exists():
            new_issuer(self.authority(), f"Issuer of {name}", now, AUTHORITY_DAYS).save(*files)
        issuer = load(*files)
        target = self.path / "stations" / name
        target.mkdir(mode=0o700, parents=True, exist_ok=True)
        issue(issuer, name, now, days * DAY).save(target / "station.pem", target / "station.key", issuer.pem)
        replace_file(target / "ca.pem", self._trusted())
        self._write(register)
        return register != before

    def revoke(self, name: str) -> None:
        """Forget a station and its issuer.

        Raises:
            NotFoundError: there is no such station.
        """
        register = self.register()
        if name not in register.stations:
            raise NotFoundError(f"no station {name!r}; there are {', '.join(register.stations) or 'none'}")
        stations = {other: station for other, station in register.stations.items() if other != name}
        self._write(register.model_copy(update={"stations": stations}))
        for file in self._files(f"issuers/{name}"):
            file.unlink(missing_ok=True)
        shutil.rmtree(self.path / "stations" / name, ignore_errors=True)

    def join(self, name: str, endpoint: str, authority: bytes) -> None:
        """Let the robot dial a router and its stations trust it.

        Args:
            name: common name of the router's certificate.
            endpoint: where it listens.
            authority: who certified it, PEM.

        Raises:
            InputError: the name is taken by a station.
        """
        before = self.register()
        made = before.model_dump() | {"router": {"name": name, "endpoint": endpoint}}
        register = _validated(CertificateRegister, made, name)
        replace_file(self.path / ROUTER_FILE, authority)
        for station in register.stations:
            replace_file(self.path / "stations" / station / "ca.pem", self._trusted())
        self._write(register)

    def authority(self) -> Certificate:
        """The authority.

        Raises:
            InputError: a file is missing or damaged.
        """
        return load(*self._files("authority"))

    def issuer(self, name: str) -> Certificate:
        """Who certifies a station. Raises as ``authority`` does."""
        return load(*self._files(f"issuers/{name}"))

    def certificates(self, now: int) -> list[Expiry]:
        """Everything certified, with the days that are left.

        Args:
            now: real time, s.
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
            Expiry(name, role, rank, seconds_left(read_certificate(file), now) // DAY)
            for name, role, rank, file in rows
        ]

    def zenoh(self) -> ZenohConfig:
        """The robot's section of the configuration.

        Raises:
            InputError: no pilot or engineer is certified yet.
        """
        return _validated(ZenohConfig, _zenoh(self.register()), self.path)

    def _write(self, register: CertificateRegister) -> None:
        """The register, and what follows from it for the robot."""
        replace_file(self.path / "register.yaml", yaml_text(register.model_dump(mode="json")))
        driving = register.of_role(AccessRole.PILOT, AccessRole.ENGINEER)
        for file, names in (("stations.pem", tuple(register.stations)), ("pilots.pem", driving)):
            issuers = [self._files(f"issuers/{name}")[0].read_bytes() for name in names]
            replace_file(self.robot / file, b"".join([*issuers, *([self._router()] if file == "stations.pem" else [])]))
        replace_file(
            self.robot / "zenoh.yaml",
            "# Written by `monstertruckd security`; include it in the robot's configuration.\n"
            + yaml_text({"version": VERSION, "zenoh": _zenoh(register)}),
        )

    def _router(self) -> bytes:
        """Who certified the fleet's router; nothing without one."""
        file = self.path / ROUTER_FILE
        return file.read_bytes() if file.exists() else b""

    def _trusted(self) -> bytes:
        """Whom a station believes: the robot's authority, and the router's."""
        return (self.path / "authority.pem").read_bytes() + self._router()

    def _files(self, name: str) -> tuple[Path, Path]:
        return self.path / f"{name}.pem", self.path / f"{name}.key"


def _zenoh(register: CertificateRegister) -> dict[str, Any]:
    """The robot's configuration as plain data."""
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
        "listen_pilots": [f"tls/0.0.0.0:{PILOTS_PORT}"],
        "connect": [] if router is None else [router.endpoint],
        "tls": tls,
    }


def _validated(model: type[S], data: Any, where: Path | str) -> S:
    try:
        return model.model_validate(data, strict=False)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        place, text = ".".join(map(str, detail["loc"])), detail["msg"].removeprefix("Value error, ")
        raise InputError(f"{where}: {place}{': ' if place else ''}{text}") from None
