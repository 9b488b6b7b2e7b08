"""Parts of the calibration's benchmark."""
