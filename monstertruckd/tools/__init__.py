"""Tools outside the daemon: one package for each job, and `cli`, whose commands open them."""
