"""Folders of saved maps: every save is a separate folder, written atomically.

``saves/NNNNNN`` below a map's folder contains one save: grid, pose graph, ground and points of interest, and a manifest
with their checksums. It is written under another name, synced and renamed. Files that a writer does not replace are
taken from the previous save of the same run; another run makes another map, with another origin. Readers use the latest
intact save.

Folders of earlier versions and of other programs contain their files without a manifest.
"""

import errno
import fcntl
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import Field

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import contents, reading
from monstertruck_runtime.small_files import SCRATCH, make_folder, require_file, sync_folder
from monstertruck_schemas.base import Schema

YAML: Final = "map.yaml"
"""File of the grid, in map_server's format."""
SAVES: Final = "saves"
"""Folder of the saves in a map's folder."""
MANIFEST: Final = "manifest.json"
_NUMBER: Final = re.compile(r"\d{6,}")
_LOOSE: Final = (YAML, "map.png", "graph.npz", "ground.npz", "points.json", "point-*.jpg")
"""Files of earlier versions without a manifest; a new map replaces them."""


class _SavedFile(Schema):
    """One file of a save."""

    size: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Manifest(Schema):
    """Content of a save."""

    version: Literal[1] = 1
    run: str
    """Run that made the map; empty for a map without a manifest."""
    parts: dict[Annotated[str, Field(pattern=r"^[\w-][\w.-]*$")], _SavedFile]


@dataclass(frozen=True, slots=True)
class MapSave:
    """One save while it is open."""

    folder: Path
    run: str = ""
    """Run that made the map; empty for a map without a manifest."""
    remarks: tuple[str, ...] = ()
    """Newer saves that are damaged."""
    beside: Path | None = None
    """Latest save of additions to a map without a manifest."""

    def file(self, name: str) -> Path:
        """Path of a file of the save; the file may not exist."""
        if self.beside is not None and (self.beside / name).exists():
            return self.beside / name
        return self.folder / name


def folder_of(place: Path) -> Path | None:
    """Folder of the saved map at ``place``, which may be its ``map.yaml``; None for a map_server YAML elsewhere."""
    if place.is_dir():
        return place
    return place.parent if place.name == YAML and (place.parent / SAVES).is_dir() else None


@contextmanager
def opened(folder: Path) -> Iterator[MapSave]:
    """Yield the latest intact save of a map's folder; it is kept until the context ends.

    Raises:
        InputError: all saves are damaged; the message names file and damage of each.
    """
    if not (folder / SAVES).is_dir():
        yield MapSave(folder)
        return
    with _locked(folder / SAVES, fcntl.LOCK_SH):
        yield _newest(folder)


def holds_map(folder: Path, run: str) -> bool:
    """Whether ``run`` wrote the latest intact save of a grid."""
    try:
        with opened(folder) as save:
            return save.run == run and save.file(YAML).exists()
    except InputError:
        return False


def write_save(
    folder: Path, parts: Mapping[str, bytes], owned: Sequence[str] = (), run: str | None = None, *, new: bool = True
) -> Path | None:
    """Write a save with ``parts``, and with the previous save's files that are not ``owned``.

    When this returns, the save survives a power cut. The previous save, the last one with the previous grid, and the
    latest map of the previous run are kept.

    Args:
        folder: folder of the map.
        parts: content by file name.
        owned: patterns of the file names managed by the caller: files not among ``parts`` are omitted.
        run: run that made the map; None: the run of the existing map.
        new: write even if there are no ``parts`` and no owned files to omit.

    Returns:
        Folder of the save; None if there was nothing to write.

    Raises:
        OSError: a file could not be written; the previous save remains the latest.
    """
    saves = folder / SAVES
    make_folder(saves)
    with _locked(saves, fcntl.LOCK_EX):
        _remove_leftovers(saves)
        run = _run(folder, run)
        before, known = _base(saves, run)
        kept = {n: p for n, p in known.items() if n not in parts and not any(fnmatchcase(n, o) for o in owned)}
        if not new and not parts and len(kept) == len(known):
            return None
        manifest = _Manifest(run=run, parts=kept | {name: _part(data) for name, data in parts.items()})
        fresh = Path(tempfile.mkdtemp(dir=saves, suffix=SCRATCH))
        try:
            fresh.chmod(0o755)
            for name in manifest.parts:
                if name in parts or before is None:
                    _write(fresh / name, parts[name])
                else:
                    _take_over(before / name, fresh / name)
            _write(fresh / MANIFEST, manifest.model_dump_json(indent=1).encode() + b"\n")
            sync_folder(fresh)
            number = max((int(path.name) for path in numbered_saves(saves)), default=0) + 1
            place = saves / f"{number:06d}"
            fresh.rename(place)
        except BaseException:
            shutil.rmtree(fresh, ignore_errors=True)
            raise
        sync_folder(saves)
        _prune(saves)
        if YAML in parts:
            _remove_loose(folder)
        return place


def tidy(folder: Path) -> list[Path]:
    """Remove and return the leftovers of killed writers in a map's folder.

    Raises:
        OSError: it cannot be removed.
    """
    if not (folder / SAVES).is_dir():
        return []
    with _locked(folder / SAVES, fcntl.LOCK_EX):
        return _remove_leftovers(folder / SAVES)


@contextmanager
def _locked(saves: Path, how: int) -> Iterator[None]:
    handle = os.open(saves, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, how)
        yield
    finally:
        os.close(handle)


def numbered_saves(saves: Path) -> list[Path]:
    """Saves in a map's folder of saves, latest first; other entries of the folder are ignored."""
    found = (path for path in saves.iterdir() if _NUMBER.fullmatch(path.name))
    return sorted(found, key=lambda path: int(path.name), reverse=True)


def _newest(folder: Path) -> MapSave:
    """Latest intact save with a grid; without one, the latest intact save.

    Raises:
        InputError: all saves are damaged.
    """
    remarks, others = list[str](), list[MapSave]()
    for path in numbered_saves(folder / SAVES):
        try:
            manifest = _check(path)
        except InputError as error:
            remarks.append(f"{error}; an older save is loaded instead")
            continue
        if YAML in manifest.parts:
            return MapSave(path, manifest.run, tuple(remarks))
        others.append(MapSave(path, manifest.run))
    if (folder / YAML).exists():
        beside = next((save.folder for save in others if not save.run), None)
        return MapSave(folder, remarks=tuple(remarks), beside=beside)
    if remarks and not others:
        raise InputError("; ".join(remark.partition("; an older")[0] for remark in remarks))
    found = others[0] if others else MapSave(folder)
    return MapSave(found.folder, found.run, tuple(remarks))


def _run(folder: Path, run: str | None) -> str:
    """Return ``run``, or the run of the existing map."""
    if run is not None:
        return run
    try:
        return _newest(folder).run
    except InputError:
        return ""


def _base(saves: Path, run: str) -> tuple[Path | None, Mapping[str, _SavedFile]]:
    """Return the latest intact save of a run, and its content."""
    for path in numbered_saves(saves):
        try:
            manifest = _check(path)
        except InputError:
            continue
        if manifest.run == run:
            return path, manifest.parts
    return None, {}


def _check(save: Path) -> _Manifest:
    """Check a save against its manifest.

    Raises:
        InputError: a file is damaged, missing or of another save.
    """
    manifest = _manifest(save)
    for name, part in manifest.parts.items():
        with reading(save / name, "a file of this save"):
            require_file(save / name)
            with (save / name).open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                digest = hashlib.file_digest(file, "sha256").hexdigest() if size == part.size else ""
        if size != part.size:
            raise InputError(f"{save / name}: {size} bytes, expected {part.size} as in {MANIFEST}")
        if digest != part.sha256:
            raise InputError(f"{save / name}: its checksum differs from {MANIFEST}: damaged, or from another save")
    return manifest


def _manifest(save: Path) -> _Manifest:
    """Expected content of a save.

    Raises:
        InputError: it is unknown.
    """
    path, expected = save / MANIFEST, "the manifest of a saved map"
    with reading(path, expected):
        return _Manifest.model_validate_json(contents(path, expected, 1_000_000))  # maximum size of a manifest, bytes


def _part(data: bytes) -> _SavedFile:
    return _SavedFile(size=len(data), sha256=hashlib.sha256(data).hexdigest())


def _write(path: Path, data: bytes) -> None:
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _take_over(old: Path, new: Path) -> None:
    """Link a file of another save into this one; copy it if the file system has no hard links."""
    try:
        new.hardlink_to(old)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.EMLINK):
            raise
        _write(new, old.read_bytes())


def _prune(saves: Path) -> None:
    """Remove all saves except the latest two, the latest of two different grids, and the last map of another run."""
    grids, runs = set[int](), set[str]()
    for age, path in enumerate(numbered_saves(saves)):
        grid = {(path / YAML).stat().st_ino} if (path / YAML).exists() else set[int]()
        run = _runs_of(path) if grid else set[str]()
        another = (len(grids) < 2 and not grid <= grids) or (len(runs) < 2 and not run <= runs)
        grids |= grid
        runs |= run
        if age >= 2 and not another:
            doomed = path.rename(path.with_name(f"{path.name}{SCRATCH}"))  # no reader sees half a save
            shutil.rmtree(doomed)


def _runs_of(save: Path) -> set[str]:
    """Run of a save; empty if its manifest is damaged."""
    try:
        return {_manifest(save).run}
    except InputError:
        return set()


def _remove_leftovers(saves: Path) -> list[Path]:
    """Remove unfinished saves; the folder is locked, so no writer is active."""
    found = list(saves.glob(f"*{SCRATCH}"))
    for path in found:
        shutil.rmtree(path)
    return found


def _remove_loose(folder: Path) -> None:
    """Remove the files of a map without a manifest."""
    for pattern in _LOOSE:
        for path in folder.glob(pattern):
            if path.is_file():
                path.unlink()
