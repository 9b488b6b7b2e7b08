"""Following a wall by sonars."""
