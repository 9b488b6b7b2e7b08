"""Simulated robots: processes and rigs of device emulators in a simulated world. Never imported by the daemon."""
