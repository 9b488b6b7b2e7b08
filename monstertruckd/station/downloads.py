"""Downloads of a robot's recordings to a browser, which resumes interrupted downloads by itself."""

import base64
import logging
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import NotFoundError, NotPermittedError, RequestRefusedError, TruckError
from monstertruck_schemas.reasons import Reason
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.recordings import Fetched, fetch_recording

log = logging.getLogger(__name__)

LARGEST_RECORDING: Final = 2_000_000_000
"""Maximum size of a recording fetched for showing (bytes): it is kept in the station's temporary folder."""
RANGE: Final = re.compile(r"bytes=(\d{1,15})-")


async def download(
    request: web.Request,
    address: RobotAddress,
    name: str,
    user: str,
    clock: Clock,
    headers: Mapping[str, str],
    may: Callable[[], bool],
) -> web.StreamResponse:
    """Answer a request for a recording; the robot limits the rate.

    A ``Range`` of the form ``bytes=N-`` returns the bytes from N (RFC 9110, 14.2); other ranges are ignored. A download
    stops when its user no longer ``may`` have it.

    Raises:
        web.HTTPException: the robot refuses or is absent, or the range starts beyond the end.
    """
    async with _session(address, user, clock) as truck:
        offset = _begin(request.headers.get("Range"))
        try:
            first = await truck.call("recording_read", {"name": name, "offset": offset})
        except TruckError as error:
            raise _failure(error) from error
        size = int(first["bytes"])
        if 0 < offset >= size:
            raise web.HTTPRequestRangeNotSatisfiable(headers={"Content-Range": f"bytes */{size}"})
        response = web.StreamResponse(status=206 if offset else 200)
        response.content_type = "application/octet-stream"
        response.content_length = size - offset
        response.headers.update(headers)
        response.headers["Accept-Ranges"] = "bytes"
        response.headers["ETag"] = f'"{name}"'
        response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
        if offset:
            response.headers["Content-Range"] = f"bytes {offset}-{size - 1}/{size}"
        await response.prepare(request)
        if request.method != "HEAD":
            await _stream(response, truck, name, first, offset, size, may)
        return response


async def fetch(
    address: RobotAddress, name: str, user: str, clock: Clock, to: Path, progress: Callable[[float], object]
) -> Fetched:
    """Fetch a recording into a file, resuming a partial one; calls ``progress`` with the fraction fetched.

    Raises:
        InputError: the recording is larger than ``LARGEST_RECORDING``.
        TruckError: the robot refuses or is absent.
    """
    async with _session(address, user, clock) as truck:
        return await fetch_recording(truck, name, to, progress, LARGEST_RECORDING)


def _session(address: RobotAddress, user: str, clock: Clock) -> TruckClient:
    return address.session(f"{user}{'.' * bool(user)}files", clock, 5.0)  # timeout of the robot's answer (s)


async def _stream(
    response: web.StreamResponse,
    truck: TruckClient,
    name: str,
    answer: dict[str, Any],
    at: int,
    size: int,
    may: Callable[[], bool],
) -> None:
    """Forward chunks up to the promised size; a failed chunk breaks the connection, so the browser notices.

    An empty chunk also breaks the connection: the file has become shorter, and further requests would never end.
    """
    while True:
        data = base64.b64decode(answer["data"])[: size - at]
        await response.write(data)
        at += len(data)
        if at >= size:
            return
        try:
            if not data:
                raise NotFoundError("the recording became shorter")
            if not may():
                raise NotPermittedError("its user has lost the permission")
            answer = await truck.call("recording_read", {"name": name, "offset": at})
        except TruckError as error:
            log.warning("download of %s aborted at %d of %d bytes: %s", name, at, size, error)
            raise ConnectionResetError(str(error)) from error


def _begin(header: str | None) -> int:
    found = RANGE.fullmatch(header or "")
    return 0 if found is None else int(found[1])


def _failure(error: TruckError) -> web.HTTPException:
    if isinstance(error, NotFoundError):
        return web.HTTPNotFound(text=str(error))
    if isinstance(error, RequestRefusedError):
        busy = error.refusal is Reason.BUSY
        return web.HTTPTooManyRequests(text=str(error)) if busy else web.HTTPForbidden(text=str(error))
    return web.HTTPGatewayTimeout(text=str(error))
