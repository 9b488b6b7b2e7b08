"""Missions: sequences of steps, each done as a goal, behaviour or exploration."""
