"""What is not the daemon: one room for each job, and `cli`, whose commands open them."""
