"""Calibration files: written by the calibration commands, laid over the configuration."""
