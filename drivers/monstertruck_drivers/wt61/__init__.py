"""WitMotion WT61 inertial measurement unit."""
