"""Which calibrations a robot still needs, in the order in which each can use the results before it."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

from monstertruck_schemas.body import LensConfig
from monstertruckd.config.calibration import Result, WizardName
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.sonar import BODIES


@dataclass(frozen=True, slots=True)
class SequenceStep:
    """One run of a wizard."""

    name: WizardName
    complete: str
    """Estimate that its result has once this step is done"""
    rough: bool = False
    """A first measurement, on which the others rest: skipped once there is any result of this wizard"""
    heights: bool = False
    """How level the lidar is, too: for one that no stabiliser levels, whose zeros are that"""


ORDER: Final = (
    SequenceStep("battery", "gain"),
    SequenceStep("drive", "inverted", rough=True),
    SequenceStep("steering", "front_centre", rough=True),
    SequenceStep("compass", "hard_x"),
    SequenceStep("drive", "drive_ratio"),
    SequenceStep("steering", "front_scale"),
    SequenceStep("odometry", "wheelbase"),
    SequenceStep("stabiliser", "pitch_zero"),
    SequenceStep("lidar", "pitch", heights=True),
    SequenceStep("lidar", "x"),
    SequenceStep("imu", "rate_scale"),
    SequenceStep("slip", "icr_left"),
    SequenceStep("sonar", "cone"),
    SequenceStep("camera", "focal_x"),
)
"""The steering's direction needs the drive's sign, a compass circle the steering's direction, a taped straight wheels
that are about straight, gains of the steering true metres and headings, squares and the lidar's mount all of them, and
the camera's mount the lidar's."""


def fits(step: SequenceStep, config: TruckConfig) -> bool:
    """Whether a robot has what the step measures."""
    devices, truck = config.devices, config.body.kind == "truck"
    match step.name:
        case "battery":
            steering = devices.steering
            return config.monitors.battery is not None or (steering is not None and steering.driver.battery is not None)
        case "steering" | "odometry":
            return truck and devices.steering is not None and devices.compass is not None and devices.drive is not None
        case "stabiliser":
            return devices.stabiliser is not None and devices.compass is not None and devices.lidar is not None
        case "camera":
            return devices.camera is not None and isinstance(getattr(devices.camera.driver, "lens", None), LensConfig)
        case "sonar":
            return "sonar" in devices.present() and config.body.kind in BODIES
        case "slip":
            return config.body.kind == "skid_steer" and config.stand != "none"
        case "lidar":
            lidar = truck and devices.lidar is not None and devices.compass is not None
            return lidar and step.heights == (devices.stabiliser is None)
        case "drive" | "compass" | "imu":
            return truck and step.name in devices.present()


def missing(
    config: TruckConfig, results: Mapping[WizardName, Result], expired: Collection[str] = ()
) -> list[SequenceStep]:
    """Steps that are still to be done.

    Args:
        config: of the robot.
        results: of the wizards so far.
        expired: wizards whose results no longer count.
    """
    found = []
    for step in ORDER:
        result = results.get(step.name)
        done = result is not None and result.estimate(step.complete) is not None
        if fits(step, config) and not (done and (step.rough or step.name not in expired)):
            found.append(step)
    return found
