"""Simulation settings: the section ``sim`` of a configuration."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Schema
from monstertruck_sim.world.config import CameraConfig, HeldBoard, WorldConfig


class DrillConfig(Schema):
    """Random faults injected while a simulated truck runs."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the faults and their times"""
    period: Annotated[float, Field(gt=0)] = 10.0
    """Mean interval between faults (s)"""


class CeilingCamera(CameraConfig):
    """Rendered camera of the test stand, fixed in the map and looking down; available only with engine mujoco."""

    port: Path
    """Symbolic link created for the camera; the stand's camera of kind `rendered` uses the same one"""
    x: float = 0.0
    """x in the map (m)"""
    y: float = 0.0
    """y in the map (m)"""
    height: Annotated[float, Field(gt=0)] = 2.2
    """Height above the ground (m)"""
    pitch: float = 1.5707963268
    """Downwards positive (rad): at 90 degrees the camera looks down, with the upper edge of the image towards `yaw`"""
    rendered: Literal[True] = True


class StandConfig(Schema):
    """Test stand that observes the simulated robot from outside."""

    rate: Annotated[float, Field(gt=0, le=100)] = 20.0
    """Pose rate (Hz)"""
    position_noise: Annotated[float, Field(ge=0)] = 0.001
    """Standard deviation of x and of y (m), as of a camera above the table"""
    heading_noise: Annotated[float, Field(ge=0)] = 0.01
    """Standard deviation of the heading (rad)"""
    cameras: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")], CeilingCamera] = Field(default_factory=dict)
    """Cameras of `stand run`, by name"""
    board: HeldBoard | None = None
    """Board in the images, with which `stand calibrate` calibrates the lenses"""


class SimConfig(Schema):
    """Simulation settings."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of all random values"""
    deadman_wired: bool = False
    """Whether the servo controller's deadman output is wired to the drive controller's quick-stop input"""
    servo_timeout: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Serial timeout of the servo controller (s); 0 for off, the factory setting"""
    as_built: bool = False
    """Whether properties of the robot that ``world`` omits (body, geometry, mounts, servos, motor, pack) come from the
    rest of the configuration; otherwise those of the Monstertruck are used
    """
    world: WorldConfig = WorldConfig()
    stand: StandConfig = StandConfig()
    """How `stand: simulator` observes the robot"""
    drill: DrillConfig | None = None
    """Random faults; null disables them"""
    recording: Path | None = None
    """Lidar recording (text columns, gzip) that the emulated lidar serves instead of the world"""

    @model_validator(mode="after")
    def _check_cameras(self) -> Self:
        if self.stand.cameras and self.world.engine != "mujoco":
            raise ValueError("stand.cameras: rendered in three dimensions: expected world.engine mujoco")
        return self
