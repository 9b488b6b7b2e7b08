"""Errors that the wizards assume of tape, board, floor, tyres and sensors, in one place: the budget of their intervals.

Each is a standard deviation, unless it says otherwise. A number here is a property of the workshop, not of the method:
a glass board or another tape has its own.
"""

import math
from typing import Annotated, Final

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema

Share = Annotated[float, Field(gt=0, le=1)]


class AssumedErrors(Schema):
    """What no wizard can measure."""

    board_flatness: Positive = 0.001
    """Distance of a board's middle from its plane (m)."""
    board_warp: Positive = 0.003
    """Direction of a line on a board (rad)."""
    board_range: Positive = 0.004
    """Excess of the lidar's range on a board's surface (m)."""
    board_size: Share = 0.003
    """Relative error of a board's size: a ruler, and paper."""
    tape_reading: Positive = 0.002
    """A reading of a tape (m)."""
    tape_scale: Share = 0.0005
    """Relative error of a class II tape, including its sag."""
    tape_floor: Share = 0.5
    """Unevenness of the floor, as a share of the tape's standard deviation."""
    string_direction: Positive = 0.0035
    """Direction of a string along the truck (rad): 1.4 mm on 0.4 m."""
    compass_tilt: Positive = math.radians(0.2)
    """Tilt at rest by the compass (rad)."""
    floor_slip: Share = 0.003
    """Relative change of a distance driven on another floor; half a 95 % interval."""
    leg_direction: Positive = 0.005
    """Direction of travel on one leg, by tyres (rad)."""
    leg_distance: Share = 0.006
    """Relative distance of one leg, by slip."""
    turning_centre: Positive = 0.002
    """Distance of the turning centre of all arcs ahead or behind, by tyres that slip outward (m)."""
    square_place: Positive = 0.03
    """Final position of a square, by slip over 10 m (m)."""
    square_linkage: Share = 0.004
    """Relative error of a linkage's polynomials in the turn of a square; half a 95 % interval."""
    square_on_the_spot: Share = 0.004
    """Relative turn of the body by steering at standstill at the ends of a corner; half a 95 % interval: 0.005 rad
    among rigid bodies."""
    sliding: Share = 0.004
    """Relative error of a skidding body's model: of the distance, along and across, and of the turn."""
    rest_position: Positive = 0.0005
    """Minimum of a position at rest (m)."""
    rest_heading: Positive = 0.001
    """Minimum of a heading at rest (rad)."""
    sonar_noise: tuple[Positive, Share] = (0.005, 0.01)
    """Range of a sonar: m, and share of it, added in quadrature."""
    sonar_arc: tuple[Positive, Positive, Share] = (0.003, 0.003, 0.01)
    """Odometry on an arc: distance from the wall (m) and heading (rad) since the previous arc, and relative excess of
    the turn, due to gyroscopes and slipping wheels."""
    sonar_scale: tuple[Share, Share] = (0.01, 0.003)
    """Shares, before anything is measured: of the speed of sound (6 degrees Celsius), and of the distance by odometry,
    as wheels roll a little further or less far on another floor or under another load."""
    turn_heading: Positive = 0.002
    """Turn between two rests (rad): rounding and noise of averaged headings."""
    turn_compass: Positive = 0.006
    """Turn by the compass's own slow error over the heading (rad); none for a full turn."""
    turn_slip: Positive = 0.004
    """Turn per root metre by tyres that never roll quite along their plane (rad)."""
    turn_linkage: Share = 0.005
    """Relative error of the linkage's polynomials in a turn."""
    weave_linearity: Positive = 1.5e-4
    """Square of the lag (s^2) that a curvature looks like which is 2 % from linear in the angles."""
    servo_wait: Positive = 0.010
    """Half the period of the servo pulses (s), half a uniform interval. How long a command waits for the next pulse is
    constant while the daemon runs, and another time after each start: nothing in the period can be excluded."""

    def beam_angle(self, tape: float, apart: float) -> float:
        """Return the error of a beam's angle to the body (rad), by two heights and the compass.

        Args:
            tape: error of a taped height (m).
            apart: distance of the heights along the beam (m).
        """
        heights = math.hypot(tape * math.sqrt(2), self.tape_floor * tape)
        return math.hypot(heights / apart, self.compass_tilt)

    def turn_of_leg(self, sigma: float, distance: float) -> float:
        """Return the error of a turn (rad) that is measured to ``sigma`` (rad) over a distance (m)."""
        return math.hypot(sigma, self.turn_slip * math.sqrt(distance))

    def place_of_leg(self, sigma: float, distance: float) -> float:
        """Return the error of a leg's end (m) that is measured to ``sigma`` (m) over a distance (m)."""
        return math.hypot(sigma, self.leg_distance * distance, self.leg_direction * distance)


ASSUMED: Final = AssumedErrors()
