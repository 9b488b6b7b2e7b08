"""Basicmicro RoboClaw, used as a counter of two quadrature encoders."""
