"""Stanley controller for any steering mode: steers the leading axle back to its reference position.

The reference position is the axle's position while the base follows the path, so curves leave no error. The controller
follows Hoffmann, Tomlin, Montemerlo and Thrun (ACC 2007). In reverse the rear axle leads. With both axles free each
returns to its reference position. The truck's heading returns a leading axle that cannot steer.
"""

import math

from monstertruck_planners.track.config import StanleyConfig
from monstertruck_planners.track.path_tracker import Angles, PathTracker, TrackingState


class Stanley(PathTracker[StanleyConfig]):
    """Stanley tracker; errors refer to the truck's position after the wheels have turned."""

    @property
    def prediction(self) -> float:
        """See the base class."""
        return self.response.total

    def steer(self, state: TrackingState) -> Angles:
        """Return the axle angles."""
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
        """Return the angle that steers the axle at ``x`` towards its reference position."""
        config = self.config
        offset = state.lateral_error + x * math.sin(state.heading_error)
        return -state.run.direction * math.atan(config.gain * offset / (abs(state.speed) + config.softening))

    def _by_heading(self, state: TrackingState, x: float) -> Angles:
        """Turn the truck so that the leading, fixed axle at ``x`` moves to its reference position."""
        wrong = state.heading_error - self._back(state, x)
        turn = state.target.turn - state.run.direction * self.config.heading_gain * wrong
        _, front, rear = self.geometry.steer_for_twist(1.0, -x * turn, turn)
        return float(front), float(rear)
