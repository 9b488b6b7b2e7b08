"""Goals: drive from the current pose to rest at a requested pose, or report the reason for failure."""
