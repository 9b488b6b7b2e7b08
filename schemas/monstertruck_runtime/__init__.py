"""What every room needs: clock, services, errors, wire codec, client."""
