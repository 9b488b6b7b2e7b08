"""Stepper motors on one microcontroller, by a line protocol of this project."""
