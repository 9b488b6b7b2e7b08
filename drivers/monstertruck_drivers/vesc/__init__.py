"""VESC motor controller."""
