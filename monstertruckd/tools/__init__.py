"""Tools outside the daemon: one package for each job, and `cli`, the commands that start them."""
