"""Writing the log: MCAP files of everything the bus carries, in a thread of its own."""
