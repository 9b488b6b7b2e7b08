"""Regulated pure pursuit for a truck with two steered axles: drive the arc through a point ahead."""

import math

from monstertruck_planners.track.config import PurePursuitConfig
from monstertruck_planners.track.path_tracker import Angles, PathTracker, TrackingState
from monstertruck_planners.track.segments import Projection

LEAST_SQUARE = 1e-6
"""Minimum squared goal distance used as a divisor (m^2)."""


class PurePursuit(PathTracker[PurePursuitConfig]):
    """Pure pursuit tracker; the arc begins at the truck's position after the wheels have turned."""

    @property
    def prediction(self) -> float:
        """See the base class."""
        return self.response.total

    def steer(self, state: TrackingState) -> Angles:
        """Return the axle angles of the arc through the point ahead."""
        x, y, yaw = state.pose
        goal = self._goal(state, state.s + self._lookahead(state.speed))
        c, sn = math.cos(yaw), math.sin(yaw)
        dx, dy = goal.point[0] - x, goal.point[1] - y
        ahead, aside = c * dx + sn * dy, c * dy - sn * dx
        direction = state.run.direction
        if state.steering == "crab":
            bearing = math.atan2(direction * aside, direction * ahead)
            return bearing, bearing
        if state.steering == "hybrid":
            return self._hybrid(state, ahead, aside, goal.tangent)
        arm = {"front": -self.geometry.l_r, "rear": self.geometry.l_f}.get(state.steering, 0.0)
        if arm == 0.0:
            # The turning centre lies abeam of the base point: the arc is tangent to the truck there.
            turn = 2 * aside / max(ahead**2 + aside**2, LEAST_SQUARE)
        elif arm * direction < 0:
            # The turning centre lies abeam of the rear axle, but the base point must reach the goal.
            turn = 2 * aside / max(ahead**2 + aside**2 - 2 * arm * ahead, LEAST_SQUARE)
        else:
            # The fixed axle leads, and only its own arc is stable: that axle must reach its own goal.
            tangent = goal.tangent - yaw
            lead = abs(arm)
            ahead += lead * math.cos(tangent) - arm
            aside += lead * math.sin(tangent)
            turn = 2 * aside / max(ahead**2 + aside**2, LEAST_SQUARE)
        _, front, rear = self.geometry.steer_for_twist(1.0, -arm * turn, turn)
        return float(front), float(rear)

    def _goal(self, state: TrackingState, s: float) -> Projection:
        """Return the point at ``s`` m; past a change of the steering mode the path is extended straight."""
        end = state.reference.section_end(state.s)
        if s <= end or end >= state.run.end:
            return state.run.at(s)
        # 1e-6: distance before a change of the steering mode at which the path still has the old one, m
        last = state.run.at(end - 1e-6)
        x, y, more = *last.point, s - end
        return Projection(s, (x + more * math.cos(last.tangent), y + more * math.sin(last.tangent)), last.tangent)

    def _lookahead(self, speed: float) -> float:
        config = self.config
        if config.lookahead_time == 0.0:
            return config.lookahead
        return min(max(config.lookahead_time * abs(speed), config.min_lookahead), config.lookahead)

    def _hybrid(self, state: TrackingState, ahead: float, aside: float, tangent: float) -> Angles:
        """Turn by the path heading at the goal, and cover the remainder sideways."""
        distance = max(math.hypot(ahead, aside), LEAST_SQUARE)
        heading = state.reference.state(state.s + distance).yaw
        turn = state.run.direction * math.remainder(heading - state.pose[2], math.tau) / distance
        forward = state.run.direction
        # An arc of this turn alone ends half its angle off the present heading.
        slip = math.atan2(forward * aside, forward * ahead) - 0.5 * forward * turn * distance
        slip = min(max(slip, -self.config.angle), self.config.angle)
        front, rear = self.geometry.steer_for(turn, slip)
        return float(front), float(rear)
