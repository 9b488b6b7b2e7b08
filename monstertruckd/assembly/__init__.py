"""Builds the services of a configuration and connects them to the bus."""
