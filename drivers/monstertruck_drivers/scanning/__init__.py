"""What scanners of all makers have in common."""
