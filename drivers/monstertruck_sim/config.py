"""The simulated side of a configuration: the section ``sim``."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Schema
from monstertruck_sim.world.config import CameraConfig, HeldBoard, WorldConfig


class DrillConfig(Schema):
    """Faults drawn at random while a simulated truck runs."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Which faults, and when"""
    period: Annotated[float, Field(gt=0)] = 10.0
    """Mean interval between faults (s)"""


class CeilingCamera(CameraConfig):
    """Rendered camera of the stand, fixed in the map and looking down; engine mujoco only."""

    port: Path
    """Link created for the camera; the stand's camera of kind `rendered` uses the same one"""
    x: float = 0.0
    """Position in the map (m)"""
    y: float = 0.0
    """m"""
    height: Annotated[float, Field(gt=0)] = 2.2
    """Over the ground (m)"""
    pitch: float = 1.5707963268
    """Downwards positive (rad): at 90 degrees the camera looks down, with the upper edge of the image towards `yaw`"""
    rendered: Literal[True] = True


class StandConfig(Schema):
    """The test stand that sees the simulated robot from outside."""

    rate: Annotated[float, Field(gt=0, le=100)] = 20.0
    """Poses a second"""
    position_noise: Annotated[float, Field(ge=0)] = 0.001
    """Standard deviation of x and of y (m), as from a camera over the table"""
    heading_noise: Annotated[float, Field(ge=0)] = 0.01
    """Rad"""
    cameras: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")], CeilingCamera] = Field(default_factory=dict)
    """Cameras of `stand run`, by name"""
    board: HeldBoard | None = None
    """Board in the images with which `stand calibrate` calibrates the lenses"""


class SimConfig(Schema):
    """The simulated side."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of everything random"""
    deadman_wired: bool = False
    """The servo controller's deadman output is wired to the drive controller's quick-stop input"""
    servo_timeout: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Serial timeout of the servo controller (s); 0 for off, the factory setting"""
    as_built: bool = False
    """What ``world`` does not state of the robot (body, geometry, mounts, servos, motor, pack) follows from the rest of
    the configuration; otherwise the Monstertruck is used"""
    world: WorldConfig = WorldConfig()
    stand: StandConfig = StandConfig()
    """How `stand: simulator` sees the robot"""
    drill: DrillConfig | None = None
    """Faults that happen without an operator; null disables them"""
    recording: Path | None = None
    """Lidar recording (text columns, gzip) that the emulated lidar serves instead of the world"""

    @model_validator(mode="after")
    def _check_cameras(self) -> Self:
        if self.stand.cameras and self.world.engine != "mujoco":
            raise ValueError("stand.cameras: rendered in three dimensions: expected world.engine mujoco")
        return self
