"""The truck's battery: monitoring shared by all devices that measure it, and a driver for Linux IIO converters."""
