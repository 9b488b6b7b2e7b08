"""Devantech SRF08 sonars behind a USB-ISS."""
