"""Error budget of the wizards' intervals: assumed errors of tape, board, floor, tyres and sensors.

Each value is a standard deviation unless its docstring states otherwise. The values describe the workshop, not the
method: adapt them to a glass board or a better tape.
"""

import math
from typing import Annotated, Final

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema

Share = Annotated[float, Field(gt=0, le=1)]


class AssumedErrors(Schema):
    """Errors that no wizard can measure."""

    board_flatness: Positive = 0.001
    """Deviation of a board's middle from its plane (m)."""
    board_warp: Positive = 0.003
    """Direction error of a line on a board (rad)."""
    board_range: Positive = 0.004
    """Excess of the lidar's range on the surface of a board (m)."""
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
    """Error of the direction of travel on one leg, from the tyres (rad)."""
    leg_distance: Share = 0.006
    """Relative distance error of one leg, from slip."""
    turning_centre: Positive = 0.002
    """Longitudinal shift of the turning centre of all arcs, from tyres that slip outwards (m)."""
    square_place: Positive = 0.03
    """Position error at the end of a square, from slip over 10 m (m)."""
    square_linkage: Share = 0.004
    """Relative error of the linkage's polynomials in the turn of a square; half a 95 % interval."""
    square_on_the_spot: Share = 0.004
    """Relative turn of the body caused by steering at standstill at the ends of a corner; half a 95 % interval: 0.005
    rad with rigid bodies.
    """
    sliding: Share = 0.004
    """Relative error of the model of a skidding body: longitudinal distance, lateral distance and turn."""
    rest_position: Positive = 0.0005
    """Minimum position error at rest (m)."""
    rest_heading: Positive = 0.001
    """Minimum heading error at rest (rad)."""
    sonar_noise: tuple[Positive, Share] = (0.005, 0.01)
    """Range error of a sonar: constant part (m) and fraction of the range, added in quadrature."""
    sonar_arc: tuple[Positive, Positive, Share] = (0.003, 0.003, 0.01)
    """Odometry error on an arc: distance from the wall (m), heading since the previous arc (rad), and relative excess
    of the turn from gyroscopes and slipping wheels.
    """
    sonar_scale: tuple[Share, Share] = (0.01, 0.003)
    """Relative errors before the measurement: of the speed of sound (6 degrees Celsius), and of the distance by
    odometry (other floors and loads).
    """
    turn_heading: Positive = 0.002
    """Turn error between two rests (rad): rounding and noise of averaged headings."""
    turn_compass: Positive = 0.006
    """Turn error from the heading-dependent error of the compass (rad); zero for a full turn."""
    turn_slip: Positive = 0.004
    """Turn error per root metre, from tyres that do not roll exactly along their plane (rad)."""
    turn_linkage: Share = 0.005
    """Relative error of the linkage's polynomials in a turn."""
    weave_linearity: Positive = 1.5e-4
    """Apparent square of the lag (s^2) caused by a curvature that deviates from linearity by 2 %."""
    servo_wait: Positive = 0.010
    """Half the period of the servo pulses (s): half a uniform interval. The wait of a command for the next pulse is
    constant while the daemon runs and differs after each start.
    """

    def beam_angle(self, tape: float, apart: float) -> float:
        """Return the error of a beam's angle relative to the body (rad), measured by two taped heights and the compass.

        Args:
            tape: error of a taped height (m).
            apart: distance between the two heights along the beam (m).
        """
        heights = math.hypot(tape * math.sqrt(2), self.tape_floor * tape)
        return math.hypot(heights / apart, self.compass_tilt)

    def turn_of_leg(self, sigma: float, distance: float) -> float:
        """Return the error of a leg's turn (rad): ``sigma`` (rad), combined with wheel slip over ``distance`` (m)."""
        return math.hypot(sigma, self.turn_slip * math.sqrt(distance))

    def place_of_leg(self, sigma: float, distance: float) -> float:
        """Return the error of a leg's end point (m): ``sigma`` (m), combined with drift over ``distance`` (m)."""
        return math.hypot(sigma, self.leg_distance * distance, self.leg_direction * distance)


ASSUMED: Final = AssumedErrors()
