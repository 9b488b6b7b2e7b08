"""What one tick of the gate decides."""

from typing import NamedTuple

from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.events import GateEvent
from monstertruckd.gate.stops import Trip


class GateOutput(NamedTuple):
    """Commands and state of one tick: the fields of DriveCommand, SteeringCommand and GateState; events and stops."""

    action: DriveAction
    speeds: tuple[float, ...]
    """Wheel speed over ground of every driven shaft, m/s."""
    motor_velocities: tuple[float, ...]
    front: float
    rear: float
    front_servo: float
    rear_servo: float
    mode: GateMode
    holder: str | None
    role: Role | None
    lease_left: float | None
    last_seq: int | None
    speed_limit: float
    reasons: tuple[Reason, ...]
    stopping_distance: float
    events: tuple[GateEvent, ...]
    trips: tuple[Trip, ...]
