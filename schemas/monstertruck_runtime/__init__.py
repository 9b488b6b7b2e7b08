"""Common base of all packages: clock, services, errors, wire codec, client."""
