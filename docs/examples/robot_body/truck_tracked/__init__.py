"""A vehicle on two tracks, for monstertruckd."""
