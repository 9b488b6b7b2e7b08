"""The table of wizards."""

from monstertruckd.tools.calibrate import compass, drive, steering
from monstertruckd.tools.calibrate.battery import BatteryWizard
from monstertruckd.tools.calibrate.guide import Wizard


def battery_wizard(settings: BatteryWizard | None = None) -> Wizard:
    """Voltage scale."""
    doc = "scale of the battery voltage from a multimeter, and its offset from two readings apart"
    return Wizard("battery", doc, "", settings or BatteryWizard())


def compass_wizard(settings: compass.CompassWizard | None = None) -> Wizard:
    """Hard and soft iron."""
    doc = "the truck's own magnetism, from a driven circle"
    return Wizard("compass", doc, compass.ROOM, settings or compass.CompassWizard())


def drive_wizard(settings: drive.DriveWizard | None = None) -> Wizard:
    """Sign and ratio."""
    doc = "which way is forward, and how far a turn of the motor goes, from taped distances"
    return Wizard("drive", doc, drive.ROOM, settings or drive.DriveWizard())


def steering_wizard(settings: steering.SteeringWizard | None = None) -> Wizard:
    """Centre, direction, travel, pulse map."""
    doc = "centre, direction, travel and pulse map of both axles, from the truck's own turns and a string"
    return Wizard("steering", doc, steering.ROOM, settings or steering.SteeringWizard())
