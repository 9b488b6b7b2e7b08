"""Command line: one file per command group; typer only parses and prints."""
