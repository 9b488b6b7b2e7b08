"""Configuration: reads YAML with line numbers and resolves it to one typed tree."""
