"""Linear feedback: the path's curvature, and what brings the truck back onto it.

With e the lateral and h the heading error, e' = h and h' = k - k_path along the way. The curvature
k = k_path - 2 d h / L - e / L^2 makes that e'' + 2 d e' / L + e / L^2 = 0; backwards the sign of h changes.
"""

import math

from monstertruck_planners.track.path_tracker import Angles, PathTracker, TrackingState
from truck_linear.config import LinearConfig


class LinearFeedback(PathTracker[LinearConfig]):
    """See the module."""

    def steer(self, state: TrackingState) -> Angles:
        """Axle angles, rad."""
        length, direction = self.config.length, state.run.direction
        if state.steering == "crab":
            bearing = state.target.slip - state.heading_error
            bearing -= direction * math.atan(state.lateral_error / length)
            return bearing, bearing
        turn = state.target.turn - direction * 2 * self.config.damping * state.heading_error / length
        turn -= state.lateral_error / length**2
        # With one axle fixed, the point that moves straight ahead is that axle.
        fixed = {"front": -self.geometry.l_r, "rear": self.geometry.l_f}.get(state.steering, 0.0)
        _, front, rear = self.geometry.steer_for_twist(1.0, -fixed * turn, turn)
        return float(front), float(rear)
