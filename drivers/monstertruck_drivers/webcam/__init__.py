"""Supervision camera (Logitech C905 or any V4L2 camera that sends motion JPEG), real and emulated."""
