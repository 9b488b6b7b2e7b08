"""The truck's battery: monitoring shared by all measuring devices, and a source on Linux IIO converters."""
