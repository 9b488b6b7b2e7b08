"""A new driver as a package with emulator and tests."""
