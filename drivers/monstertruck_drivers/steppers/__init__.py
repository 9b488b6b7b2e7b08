"""Stepper motors on one microcontroller, controlled over a line protocol of this project."""
