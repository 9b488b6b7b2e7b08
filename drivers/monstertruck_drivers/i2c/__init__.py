"""I2C buses: kernel buses (``/dev/i2c-N``), and emulated buses behind a cable."""
