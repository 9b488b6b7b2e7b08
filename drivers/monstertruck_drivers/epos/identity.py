"""Who the controller is and how it was set up; read only."""

from dataclasses import asdict, dataclass

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.exchange import ATTEMPTS, Exchanger, ObjectError
from monstertruck_drivers.epos.objects import Entry
from monstertruck_runtime.errors import DeviceMismatchError, WrongDeviceError


@dataclass(frozen=True, slots=True)
class Identity:
    """Settings of a controller; None = it does not know the object."""

    software: int
    hardware: int | None
    motor_type: int | None
    sensor_type: int | None
    encoder_pulses_per_turn: int | None
    velocity_notation: int | None
    continuous_current_ma: int | None
    peak_current_ma: int | None
    pole_pairs: int | None
    motor_max_rpm: int | None

    def as_values(self) -> dict[str, int | None]:
        """By name, for events and reports."""
        return asdict(self)

    def counts_per_turn(self, config: EposConfig) -> int:
        """Position counts per motor turn.

        Raises:
            DeviceMismatchError: neither the controller nor the configuration says so.
        """
        pulses = self.encoder_pulses_per_turn or config.encoder_pulses_per_turn
        if pulses is None:
            raise DeviceMismatchError(f"controller lacks {od.ENCODER_PULSES}: configure encoder_pulses_per_turn")
        return pulses * od.COUNTS_PER_PULSE

    def check(self, config: EposConfig) -> None:
        """Compare with what was configured.

        Raises:
            DeviceMismatchError: driving would be wrong by a factor, or with a motor of another kind.
        """
        expected: tuple[tuple[Entry, int | None, int | None], ...] = (
            (od.ENCODER_PULSES, self.encoder_pulses_per_turn, config.encoder_pulses_per_turn),
            (od.MOTOR_TYPE, self.motor_type, config.motor_type),
            (od.VELOCITY_NOTATION, self.velocity_notation, od.RPM),
        )
        wrong = [
            f"{entry} is {value}, expected {want}"
            for entry, value, want in expected
            if value is not None and want is not None and value != want
        ]
        if wrong:
            raise DeviceMismatchError("; ".join(wrong))


async def read_identity(line: Exchanger) -> Identity:
    """Ask the controller.

    Raises:
        WrongDeviceError: what answers has no software version.
        DeviceTimeoutError, ProtocolError, DeviceLostError: as ``Exchanger.read``.
    """

    async def ask(entry: Entry) -> int | None:
        try:
            return await line.read(entry, ATTEMPTS)
        except ObjectError:
            return None

    software = await ask(od.SOFTWARE_VERSION)
    if software is None:
        raise WrongDeviceError(f"controller without {od.SOFTWARE_VERSION}: not an EPOS 24/1, or not this node")
    return Identity(
        software=software,
        hardware=await ask(od.HARDWARE_VERSION),
        motor_type=await ask(od.MOTOR_TYPE),
        sensor_type=await ask(od.SENSOR_TYPE),
        encoder_pulses_per_turn=await ask(od.ENCODER_PULSES),
        velocity_notation=await ask(od.VELOCITY_NOTATION),
        continuous_current_ma=await ask(od.CONTINUOUS_CURRENT),
        peak_current_ma=await ask(od.PEAK_CURRENT),
        pole_pairs=await ask(od.POLE_PAIRS),
        motor_max_rpm=await ask(od.MOTOR_MAX_SPEED),
    )
