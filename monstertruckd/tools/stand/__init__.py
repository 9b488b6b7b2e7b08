"""The overhead test stand: cameras over a table that locate robots."""
