"""Safety-relevant device settings: values beyond the body's limits, and values less safe than the default.

Counterpart of ``monstertruckd.gate.config`` for devices.
"""

import math
from collections.abc import Iterator
from typing import Final

from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.config import Devices, Monitors
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig, HokuyoLxConfig
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.pca9685.config import Pca9685Config, Pca9685EscConfig
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.vesc.config import VescConfig
from monstertruck_schemas.base import Schema
from monstertruckd.gate.config import BodyLimits, weaker

WEAKER_ABOVE: Final[dict[type[Schema], tuple[str, ...]]] = {
    EposConfig: (
        "max_motor_rpm",
        "status_period",
        "current_period",
        "command_timeout",
        "quick_stop_after",
        "standstill_rpm",
        "fault_resets",
    ),
    StepperConfig: ("max_rate", "answer_timeout", "command_timeout", "quick_stop_after", "watchdog"),
    ArduinoBridgeConfig: ("max_rate", "answer_timeout", "command_timeout", "auto_stop"),
    VescConfig: (
        "max_motor_rpm",
        "min_motor_rpm",
        "standstill_rpm",
        "answer_timeout",
        "command_timeout",
        "watchdog",
    ),
    MaestroConfig: ("answer_timeout", "command_timeout"),
    Pca9685Config: ("answer_timeout", "command_timeout"),
    HokuyoConfig: ("skip",),
    HokuyoLxConfig: ("skip",),
    Os4000Config: ("delay", "field_tolerance", "gravity_tolerance"),
    PackConfig: (
        "max_compensation",
        "low_after",
        "critical_after",
        "collapsed_after",
        "overcharged",
        "overcharged_after",
        "overcharged_clear",
        "plausible_max",
    ),
}
"""Settings that are weaker when increased."""

WEAKER_BELOW: Final[dict[type[Schema], tuple[str, ...]]] = {
    EposConfig: (
        "deceleration_rpm_s",
        "quick_stop_deceleration_rpm_s",
        "rate",
        "fault_reset_window",
        "fault_reset_pause",
    ),
    StepperConfig: ("acceleration", "quick_deceleration", "rate"),
    ArduinoBridgeConfig: ("deceleration", "quick_deceleration", "rate"),
    VescConfig: ("deceleration_rpm_s", "quick_stop_deceleration_rpm_s", "brake_current", "rate", "battery_rate"),
    MaestroConfig: ("poll_rate", "battery_rate"),
    Pca9685Config: ("poll_rate",),
    HokuyoConfig: (),
    HokuyoLxConfig: (),
    Os4000Config: (),
    PackConfig: ("low", "clear", "clear_after", "critical", "collapsed"),
}
"""Settings that are weaker when decreased."""

UNATTENDED: Final[dict[type[Schema], tuple[str, ...]]] = {
    EposConfig: ("command_timeout", "quick_stop_after", "status_period"),
    StepperConfig: ("command_timeout", "quick_stop_after", "watchdog"),
    ArduinoBridgeConfig: ("command_timeout", "auto_stop"),
    VescConfig: ("command_timeout", "watchdog"),
    MaestroConfig: ("command_timeout",),
    MaestroEscConfig: ("command_timeout",),
    Pca9685Config: ("command_timeout",),
    Pca9685EscConfig: ("command_timeout",),
}
"""Times during which the truck continues unattended."""

BY_CELLS: Final = (
    *("low", "clear", "critical", "collapsed", "overcharged", "overcharged_clear"),
    *("max_compensation", "plausible_max"),
)
"""Pack voltages, compared per cell."""


def unattended_times(devices: Devices) -> Iterator[tuple[str, float]]:
    """Driver settings that let the truck continue unattended, each with its name and time (s)."""
    for role, device in devices.present().items():
        driver = device.driver
        for name in UNATTENDED.get(type(driver), ()):
            yield f"devices.{role}.driver.{name}", getattr(driver, name)


def beyond_devices(devices: Devices, monitors: Monitors, standstill: float, body: BodyLimits) -> Iterator[str]:
    """Return every device setting beyond the body's limits, with the limit.

    Args:
        devices: devices of the robot.
        monitors: monitors of the robot.
        standstill: ``gate.standstill`` (m/s).
        body: limits of the body's motion.
    """
    for role, device in devices.present().items():
        driver = device.driver
        if isinstance(driver, EposConfig) and body.motor_speed is not None:
            at_rest = math.ceil(standstill / body.motor_speed * driver.max_motor_rpm)
            if driver.standstill_rpm > at_rest:
                name = f"devices.{role}.driver.standstill_rpm"
                yield f"{name} {driver.standstill_rpm}: at most {at_rest}, gate.standstill"
    for place, pack in packs(devices, monitors):
        yield from _beyond_cells(place, pack)


def weakened_devices(devices: Devices, monitors: Monitors) -> Iterator[str]:
    """Every device setting less safe than its default, with its value and the default.

    Args:
        devices: devices of the robot.
        monitors: monitors of the robot.
    """
    for role, device in devices.present().items():
        driver, place = device.driver, f"devices.{role}.driver"
        if type(driver) in WEAKER_ABOVE:
            yield from _weaker(place, driver, type(driver)())
        if isinstance(driver, StepperConfig):
            yield f"{place}: steppers report the commanded steps: a blocked or slipping wheel is not noticed"
        if isinstance(driver, Pca9685Config | Pca9685EscConfig):
            yield f"{place}: a PCA9685 has no watchdog: it repeats the latest pulses while the computer hangs"
        if isinstance(driver, MaestroEscConfig | Pca9685EscConfig):
            yield f"{place}: no sensor measures the motor: a blocked, slipping or coasting wheel is not noticed"
        if isinstance(driver, ArduinoBridgeConfig):
            yield f"{place}: its protocol has no checksum: a damaged command runs the motors until the next command"
        if isinstance(driver, MaestroConfig):
            if driver.deadman_feed == "always":
                yield f"{place}.deadman_feed always: the deadman line guards against a dead process only"
            if not any(packs(devices, monitors)):
                yield f"{place}.battery null: an empty battery is not noticed"
    for place, pack in packs(devices, monitors):
        yield from _weaker(place, pack, _usual_pack(pack))


def _weaker(place: str, config: Schema, usual: Schema) -> Iterator[str]:
    kind = PackConfig if isinstance(config, PackConfig) else type(config)
    return weaker(place, config, usual, WEAKER_ABOVE[kind], WEAKER_BELOW[kind])


def _usual_pack(pack: PackConfig) -> PackConfig:
    """Default thresholds for the same number of cells."""
    usual = PackConfig()
    share = pack.cells / usual.cells
    return usual.model_copy(update={name: round(getattr(usual, name) * share, 6) for name in BY_CELLS})


def packs(devices: Devices, monitors: Monitors) -> Iterator[tuple[str, PackConfig]]:
    """Devices that measure the battery, each with its key in the configuration."""
    if isinstance(monitors.battery, PackConfig):
        yield "monitors.battery", monitors.battery
    for role, device in devices.present().items():
        battery = getattr(device.driver, "battery", None)
        if isinstance(battery, PackConfig):
            yield f"devices.{role}.driver.battery", battery


def _beyond_cells(place: str, pack: PackConfig) -> Iterator[str]:
    empty = 3.0  # voltage of an empty lithium-polymer cell
    for name in ("low", "critical", "collapsed"):
        volts = getattr(pack, name)
        if volts < empty * pack.cells:
            yield f"{place}.{name} {volts:g} V: at least {empty * pack.cells:g}, where {pack.cells} cells are empty"
    # 4.5: cell voltage that no charger reaches, V 0.5: maximum drop of a cell's voltage by motor current, V
    for name, most in (("plausible_max", 4.5), ("max_compensation", 0.5)):
        volts = getattr(pack, name)
        if volts > most * pack.cells:
            yield f"{place}.{name} {volts:g} V: at most {most * pack.cells:g}, of {pack.cells} cells"
