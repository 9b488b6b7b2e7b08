"""Code shared by scanners of all makers."""
