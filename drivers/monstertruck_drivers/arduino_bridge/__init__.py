"""Microcontroller boards that speak the ROSArduinoBridge text protocol."""
