"""A new driver as a package with emulator, probe and tests."""
