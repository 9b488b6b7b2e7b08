"""Pololu Micro Maestro 6: two steering servos, the battery input and an optional deadman line."""
