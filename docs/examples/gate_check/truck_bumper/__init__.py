"""A bumper that stops the truck."""
