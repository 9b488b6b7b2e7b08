"""The overhead test stand: cameras over a table that say where robots are."""
