"""Planners and trackers: pure plan/control functions inside thin coroutine shells."""
