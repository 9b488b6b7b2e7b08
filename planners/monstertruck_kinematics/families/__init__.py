"""Every wheeled-robot family behind one protocol, ``Drive``."""

from monstertruck_kinematics.families.base import Drive, Twist, rolled, turning_centre
from monstertruck_kinematics.families.differential import Differential
from monstertruck_kinematics.families.four_wheel import FourWheelSteer, IndependentSteer
from monstertruck_kinematics.families.steered import Ackermann, Bicycle, Tricycle
from monstertruck_kinematics.families.swedish import SwedishDrive, mecanum, omni
from monstertruck_kinematics.families.synchro import Synchro

__all__ = [
    "Ackermann",
    "Bicycle",
    "Differential",
    "Drive",
    "FourWheelSteer",
    "IndependentSteer",
    "SwedishDrive",
    "Synchro",
    "Tricycle",
    "Twist",
    "mecanum",
    "omni",
    "rolled",
    "turning_centre",
]
