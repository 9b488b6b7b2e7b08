"""Stanley's law for any way of steering: the leading axle is pointed back to where it belongs.

Where it belongs is the place that axle has when the base follows the path, so curves leave no error; the law is that of
Hoffmann, Tomlin, Montemerlo and Thrun (ACC 2007). Backwards the rear axle leads. With both axles free each returns to
its own place. A leading axle that cannot steer is returned by the truck's heading.
"""

import math

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.actuator import Angles
from monstertruck_planners.track.config import StanleyConfig
from monstertruck_planners.track.law import Here, Law


class Stanley(Law[StanleyConfig]):
    """See the module; errors are those of where the truck will be when the wheels have turned."""

    def __init__(self, config: StanleyConfig, geometry: FourWheelSteering) -> None:
        super().__init__(config, geometry)
        self.lead = config.dead_time + config.lag

    def steer(self, here: Here) -> Angles:
        """Axle angles."""
        if here.steering == "crab":
            bearing = here.reference.slip - here.turned + self._back(here, 0.0)
            return bearing, bearing
        slip = min(max(here.reference.slip, -1.0), 1.0)
        front, rear = self.geometry.steer_for(here.reference.turn, slip)
        front = front - here.turned + self._back(here, self.geometry.l_f)
        rear = rear - here.turned + self._back(here, -self.geometry.l_r)
        forward = here.run.direction > 0
        if here.steering == "hybrid":
            return front, rear
        if here.steering == "counter":
            return (front, -front) if forward else (-rear, rear)
        if (here.steering == "front") is forward:
            return (front, 0.0) if forward else (0.0, rear)
        return self._by_heading(here, self.geometry.l_f if forward else -self.geometry.l_r)

    def _back(self, here: Here, x: float) -> float:
        """Angle by which the axle at ``x`` steers towards its place."""
        config = self.config
        offset = here.offset + x * math.sin(here.turned)
        return -here.run.direction * math.atan(config.gain * offset / (abs(here.speed) + config.softening))

    def _by_heading(self, here: Here, x: float) -> Angles:
        """The fixed axle at ``x`` leads: turn the truck so that it goes to its place."""
        wrong = here.turned - self._back(here, x)
        turn = here.reference.turn - here.run.direction * self.config.heading_gain * wrong
        _, front, rear = self.geometry.steer_for_twist(1.0, -x * turn, turn)
        return float(front), float(rear)
