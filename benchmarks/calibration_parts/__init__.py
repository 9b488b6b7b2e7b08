"""Parts of the calibration benchmark."""
