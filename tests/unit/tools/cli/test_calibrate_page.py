"""The wizards as the page offers and runs them."""

import json
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import InputError
from monstertruckd.config.calibration import Estimate, Result
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.battery import BatteryWizard
from monstertruckd.tools.cli.calibrate_page import PageCalibrator

CONFIG = load_config(Path(__file__).resolve().parents[4] / "configs" / "demo.yaml", TruckConfig)[0]


def result(value: float, **more: Any) -> Result:
    estimate = Estimate(name="gain", value=value, low=value - 0.1, high=value + 0.1, samples=3, meaning="scale", **more)
    return Result(wizard="battery", measured="three readings", estimates=(estimate,))


class Truck:
    """A robot whose battery was calibrated before."""

    source = "ann.calibrate"

    def __init__(self) -> None:
        self.saved: list[dict[str, Any]] = []
        before = result(1.5, date="2026-01-02T03:04:05Z").model_copy(update={"date": "2026-01-02T03:04:05Z"})
        results = {"battery": before.model_dump(mode="json")}
        head = {"version": 1, "number": 1, "robot": "truck", "written": "2026-01-02T03:04:05Z", "change": "battery"}
        self.content = head | {"results": results}

    async def call(self, rpc: str, payload: dict[str, Any] | None = None) -> dict[str, Any]:
        match rpc:
            case "config":
                return json.loads(CONFIG.model_dump_json())
            case "calibration":
                return {"content": self.content}
        assert rpc == "calibration_save"
        assert payload is not None
        self.saved.append(payload)
        return {"result": payload["result"], "file": "0002.json"}


class Panel:
    def say(self, text: str) -> None:
        pass


async def test_what_fits_is_offered_in_order_and_what_was_never_done_is_due():
    offered = await PageCalibrator(WallClock()).offered(Truck())  # type: ignore[arg-type]
    names = [row["id"] for row in offered]
    assert names.index("drive.inverted") < names.index("drive.drive_ratio")
    assert "camera.fx" not in names, "a robot without a camera"
    due = {row["id"]: row["due"] for row in offered}
    assert (due["battery.gain"], due["compass.hard_x"]) == (False, True)
    assert all("\n" not in row["doc"] and row["doc"] for row in offered)


async def test_a_result_stands_beside_the_one_before_and_is_saved_when_that_is_asked(monkeypatch: pytest.MonkeyPatch):
    async def measures(self: object, context: object) -> Result:
        return result(1.6)

    monkeypatch.setattr(BatteryWizard, "__call__", measures)
    truck = Truck()
    measured = await PageCalibrator(WallClock()).measure(truck, "battery.gain", {"meter_error": 1}, Panel())  # type: ignore[arg-type]
    (row,) = measured.rows
    assert (row["value"], row["before"]["value"], row["meaning"]) == (1.6, 1.5, "scale")
    assert not truck.saved
    assert await measured.save() == "0002.json"
    assert truck.saved[0]["source"] == "ann.calibrate"
    with pytest.raises(InputError, match=r"battery\.scale: unknown calibration"):
        await PageCalibrator(WallClock()).measure(truck, "battery.scale", {}, Panel())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "mistake"),
    [
        ({"rounds": 3}, "battery: option rounds: expected one of meter_error, meter_digits, fresh"),
        ({"fresh": 1}, "battery: option fresh: expected bool, got 1"),
        ({"meter_error": "small"}, "battery: option meter_error: expected float, got 'small'"),
        ({"meter_error": -1.0}, "battery: option meter_error: expected 0"),
    ],
)
async def test_a_wrong_option_is_refused_by_name(options: dict[str, Any], mistake: str):
    offered = await PageCalibrator(WallClock()).offered(Truck())  # type: ignore[arg-type]
    (battery,) = (row for row in offered if row["id"] == "battery.gain")
    assert [option["name"] for option in battery["options"]] == ["meter_error", "meter_digits", "fresh"]
    with pytest.raises(InputError, match=mistake):
        await PageCalibrator(WallClock()).measure(Truck(), "battery.gain", options, Panel())  # type: ignore[arg-type]
