"""NXP PCA9685: sixteen pulse outputs on an I2C bus, for servos and a radio-control speed controller."""
