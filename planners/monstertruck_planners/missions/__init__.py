"""Missions: steps done one after the other by goals, behaviours and explorations."""
