"""Stanley controller for any way of steering: the leading axle is pointed back to where it belongs.

Where it belongs is the place that axle has when the base follows the path, so curves leave no error; the controller is
that of Hoffmann, Tomlin, Montemerlo and Thrun (ACC 2007). Backwards the rear axle leads. With both axles free each
returns to its own place. A leading axle that cannot steer is returned by the truck's heading.
"""

import math

from monstertruck_planners.track.config import StanleyConfig
from monstertruck_planners.track.path_tracker import Angles, PathTracker, TrackingState


class Stanley(PathTracker[StanleyConfig]):
    """See the module; errors are those of where the truck will be when the wheels have turned."""

    @property
    def prediction(self) -> float:
        """See the base class."""
        return self.response.total

    def steer(self, state: TrackingState) -> Angles:
        """Axle angles."""
        if state.steering == "crab":
            bearing = state.target.slip - state.heading_error + self._back(state, 0.0)
            return bearing, bearing
        slip = min(max(state.target.slip, -1.0), 1.0)
        front, rear = self.geometry.steer_for(state.target.turn, slip)
        front = front - state.heading_error + self._back(state, self.geometry.l_f)
        rear = rear - state.heading_error + self._back(state, -self.geometry.l_r)
        forward = state.run.direction > 0
        if state.steering == "hybrid":
            return front, rear
        if state.steering == "counter":
            return (front, -front) if forward else (-rear, rear)
        if (state.steering == "front") is forward:
            return (front, 0.0) if forward else (0.0, rear)
        return self._by_heading(state, self.geometry.l_f if forward else -self.geometry.l_r)

    def _back(self, state: TrackingState, x: float) -> float:
        """Angle by which the axle at ``x`` steers towards its place."""
        config = self.config
        offset = state.lateral_error + x * math.sin(state.heading_error)
        return -state.run.direction * math.atan(config.gain * offset / (abs(state.speed) + config.softening))

    def _by_heading(self, state: TrackingState, x: float) -> Angles:
        """The fixed axle at ``x`` leads: turn the truck so that it goes to its place."""
        wrong = state.heading_error - self._back(state, x)
        turn = state.target.turn - state.run.direction * self.config.heading_gain * wrong
        _, front, rear = self.geometry.steer_for_twist(1.0, -x * turn, turn)
        return float(front), float(rear)
