"""Robots found at a router."""

import asyncio
from contextlib import suppress

import pytest

from monstertruck_runtime.clock import WallClock
from monstertruckd.station.discovery import Discovery
from tests.bus_kit import free_endpoint


async def test_why_a_router_shows_no_robots_is_said_once(caplog: pytest.LogCaptureFixture, monkeypatch):
    endpoint = free_endpoint()
    discovery = Discovery(endpoint, WallClock(), lambda _: None)
    monkeypatch.setattr(discovery, "_retry", 0.05)
    watching = asyncio.create_task(discovery.run())
    await asyncio.sleep(0.6)
    watching.cancel()
    with suppress(asyncio.CancelledError):
        await watching
    warned = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert warned == [f"no robots from {endpoint}: nothing answers at {endpoint} within 0.05 s"]
