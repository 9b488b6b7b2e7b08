"""Device drivers: one folder per device with its codec, driver, emulator and identification."""
