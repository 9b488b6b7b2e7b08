"""The log: MCAP files of everything on the bus, the black box of every trip, their reading and repair; map pictures."""
