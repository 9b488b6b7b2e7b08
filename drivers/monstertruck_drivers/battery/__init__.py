"""The truck's battery: judgement shared by everything that measures it, and a source on Linux IIO converters."""
