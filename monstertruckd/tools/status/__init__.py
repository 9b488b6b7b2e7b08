"""The live status screen."""
