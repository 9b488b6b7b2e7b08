"""Linear state feedback, a path tracker for monstertruckd."""
