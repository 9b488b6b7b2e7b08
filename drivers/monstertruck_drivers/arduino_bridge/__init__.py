"""Microcontroller boards that speak the text protocol of ROSArduinoBridge."""
