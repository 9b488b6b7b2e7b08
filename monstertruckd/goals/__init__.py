"""Goals in the daemon: requests in, routes planned and deformed elsewhere, paths out."""
