"""Hokuyo URG-04LX laser scanner: SCIP 1.1 and 2.0 codec, driver, emulator, recorded scans and identification."""
