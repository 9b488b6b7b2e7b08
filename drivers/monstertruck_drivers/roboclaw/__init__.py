"""Basicmicro RoboClaw, used as a counter for two quadrature encoders."""
