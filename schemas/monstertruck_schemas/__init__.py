"""The contract of the whole system: typed messages with units, and the topic table."""
