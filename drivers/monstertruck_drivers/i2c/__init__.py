"""I2C buses: of the kernel (``/dev/i2c-N``), and emulated behind a cable."""
