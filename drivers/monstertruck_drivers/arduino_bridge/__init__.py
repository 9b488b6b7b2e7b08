"""Microcontroller boards with the text protocol of ROSArduinoBridge."""
