"""State of a robot: settings, missions, users, certificates, calibration, odometer, latch."""

import asyncio
import random
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from benchmarks.durability_parts.subject import Death, Subject
from monstertruck_planners.missions.progress import MissionFrame, MissionProgress
from monstertruck_planners.missions.service import MissionInputs, MissionService
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.small_files import SCRATCH, remove_leftovers
from monstertruck_runtime.threads import inline
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.roles import AccessRole
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result
from monstertruckd.config.expiry import DistanceCounter
from monstertruckd.config.load import SavedSettings
from monstertruckd.gate.latch import EstopLatch
from monstertruckd.station.users import StationUsers, add_user
from monstertruckd.tools.security.certificates import load
from monstertruckd.tools.security.folder import Folder

NOON: Final = 1_800_000_000
"""Real time of all that is dated, s."""
KEYS: Final = ("gate.limits.speed", "gate.limits.acceleration", "tracker.lookahead")


def _numbered(acknowledged: list[str]) -> int:
    """Return the number of the latest acknowledged change; 0 before the first."""
    return int(acknowledged[-1]) if acknowledged else 0


def _tidy(folder: Path) -> str | None:
    """Remove leftovers as at a start; describe any that remain."""
    remove_leftovers(folder)
    left = [path.name for path in folder.glob(f"*{SCRATCH}")]
    return f"left behind: {left}" if left else None


def _one_of(found: int, acknowledged: list[str]) -> str | None:
    """Whether a number is the acknowledged one, or that of the change in progress."""
    newest = _numbered(acknowledged)
    return None if found in (newest, newest + 1) else f"{found}, acknowledged {newest}"


# Settings


def _write_settings(folder: Path, seed: int) -> Iterator[str]:
    settings, rng, number = SavedSettings(folder / "state", "truck"), random.Random(seed), 0
    while True:
        number += 1
        key = rng.choice(KEYS)
        settings.save({key: float(number)})
        yield f"{key} {number}"


def _check_settings(folder: Path, acknowledged: list[str], _: Death) -> str | None:
    wrong = _tidy(folder / "state")
    values = {key: value for key, (value, _) in SavedSettings(folder / "state", "truck").values().items()}
    newest: dict[str, int] = {}
    for line in acknowledged:
        key, number = line.split()
        newest[key] = int(number)
    following = max(newest.values(), default=0) + 1
    for key in KEYS:
        if values.get(key, 0) not in (newest.get(key, 0), following):
            return f"{key}: {values.get(key)}, acknowledged {newest.get(key)}"
    return wrong


# Missions


def missions(file: Path) -> MissionService:
    """Return the service with the parts it needs to keep a mission in ``file``."""
    nothing: Any = SimpleNamespace(latest=None)
    inputs: Any = SimpleNamespace(**dict.fromkeys((field.name for field in fields(MissionInputs)), nothing))

    def report(reason: object, severity: object, source: str, text: str = "", **_: object) -> None:
        raise OSError(text)

    return MissionService(
        nothing, WallClock(), file=file, localised=False, offload=inline, max_age=1.0,
        inputs=inputs, state=nothing, events=report,
    )  # fmt: skip


def _write_missions(folder: Path, seed: int) -> Iterator[str]:
    service, number = missions(folder / "state" / "mission.json"), 0
    (folder / "state").mkdir()
    EstopLatch(folder / "state" / "estop", folder).prepare()
    while True:
        number += 1
        steps = [{"do": "wait", "seconds": 1.0 + seed % 7}] * number
        mission = Mission.model_validate({"version": 2, "name": f"m{number}", "steps": steps})
        asyncio.run(service._save(MissionProgress(mission, (0.0, 0.0, 0.0), (MissionFrame(index=number - 1),))))  # noqa: SLF001
        yield str(number)
        if number % 5 == 0:
            asyncio.run(service._forget())  # noqa: SLF001
            yield "0"
            yield "0"


def _check_missions(folder: Path, acknowledged: list[str], _: Death) -> str | None:
    wrong = _tidy(folder / "state")
    saved = missions(folder / "state" / "mission.json")._load()  # noqa: SLF001 - as the service's start does
    found = 0 if saved is None else saved.stack[0].index + 1
    if saved is not None and saved.mission.name != f"m{found}":
        return f"mixed: {saved.mission.name} at step {found}"
    numbers = [int(line) for line in acknowledged]
    under_way = {0, max(numbers, default=0) + 1} if not numbers or numbers[-1] % 5 == 0 else {numbers[-1] + 1}
    allowed = {numbers[-1] if numbers else 0} | under_way
    return wrong if found in allowed else f"mission {found}, acknowledged {numbers[-1:]}"


# Users and certificates


def _write_users(folder: Path, seed: int) -> Iterator[str]:
    rng, number = random.Random(seed), 0
    while True:
        number += 1
        add_user(folder / "station" / "users.yaml", f"user{number}", rng.choice(list(AccessRole)), "password")
        yield str(number)


def _check_users(folder: Path, acknowledged: list[str], _: Death) -> str | None:
    wrong = _tidy(folder / "station")
    if not acknowledged:
        return wrong
    file = folder / "station" / "users.yaml"
    file.chmod(0o600)  # traces hold no modes
    users = StationUsers(file)._rows  # noqa: SLF001 - as read at the start
    return _one_of(len(users), acknowledged) or wrong


def _write_certificates(folder: Path, seed: int) -> Iterator[str]:
    certified, number = Folder(folder / "security"), 0
    certified.init("truck", ("127.0.0.1",), folder / "security" / "robot", NOON)
    while True:
        number += 1
        certified.add(f"station{number}", None, None, NOON)
        yield str(number)


def _check_certificates(folder: Path, acknowledged: list[str], _: Death) -> str | None:
    certified = Folder(folder / "security")
    if not acknowledged:
        return None
    register = certified.register()
    trusted = (certified.robot / "stations.pem").read_text().count("BEGIN CERTIFICATE")
    for name in (f"station{line}" for line in acknowledged):
        if name not in register.stations:
            return f"{name} is forgotten"
        place = certified.path / "stations" / name
        load(place / "station.pem", place / "station.key")
    load(certified.robot / "robot.pem", certified.robot / "robot.key")
    return None if trusted >= len(acknowledged) else f"the robot trusts {trusted} of {len(acknowledged)} stations"


# Calibration, odometer, latch


def _result(number: int) -> Result:
    estimate = Estimate(name="drive_ratio", value=float(number), samples=4, meaning="test", key="geometry.drive_ratio")
    return Result(wizard="drive", measured="taped", estimates=(estimate,))


def _write_calibration(folder: Path, seed: int) -> Iterator[str]:
    store, number = CalibrationStore(folder / "calibration", "truck"), 0
    while True:
        number += 1
        store.save(_result(number), (NOON + seed % 1000 + number) * SECOND)
        yield str(number)


def _check_calibration(folder: Path, acknowledged: list[str], _: Death) -> str | None:
    store = CalibrationStore(folder / "calibration", "truck")
    wrong = _tidy(folder / "calibration")
    for number, path in enumerate(store.files(), start=1):
        file = store.load(path)
        estimate = file.results["drive"].estimate("drive_ratio")
        if estimate is None or (file.number, estimate.value) != (number, number):
            return f"{path.name} holds {file.number} and {estimate}"
    return _one_of(len(store.files()), acknowledged) or wrong


def _write_odometer(folder: Path, seed: int) -> Iterator[str]:
    counter = DistanceCounter(folder / "state" / "odometer.json")
    while True:
        counter.metres += 1.0
        counter.save()
        yield f"{counter.metres:.0f}"


def _check_odometer(folder: Path, acknowledged: list[str], _: Death) -> str | None:
    wrong = _tidy(folder / "state")
    counter = DistanceCounter(folder / "state" / "odometer.json")
    counter.load()
    return _one_of(round(counter.metres), acknowledged) or wrong


def _write_latch(folder: Path, seed: int) -> Iterator[str]:
    """Write the latch; every other change repeats the last one, so its result is known even if unfinished."""
    latch, rng = EstopLatch(folder / "state" / "estop", folder), random.Random(seed)
    latch.prepare()
    engaged = False
    while True:
        engaged = not engaged
        for _ in range(rng.choice((2, 3))):
            latch.store(engaged)
            yield f"{engaged:d}"
        yield f"{engaged:d} last"


def _check_latch(folder: Path, acknowledged: list[str], _: Death) -> str | None:
    wrong = _tidy(folder / "state")
    stored = EstopLatch(folder / "state" / "estop", folder).stored()
    if not acknowledged or acknowledged[-1].endswith("last"):
        return wrong  # the change of the other way is under way
    return wrong if stored is (acknowledged[-1] == "1") else f"{stored}, acknowledged {acknowledged[-1]}"


SUBJECTS: Final = (
    Subject("settings", _write_settings, _check_settings, changes=16),
    Subject("missions", _write_missions, _check_missions),
    Subject("users", _write_users, _check_users, seconds=0.6, changes=6),
    Subject("certificates", _write_certificates, _check_certificates, seconds=0.6, changes=6),
    Subject("calibration", _write_calibration, _check_calibration),
    Subject("odometer", _write_odometer, _check_odometer),
    Subject("latch", _write_latch, _check_latch),
)
