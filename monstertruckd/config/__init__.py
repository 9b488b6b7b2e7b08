"""Configuration: YAML with line numbers in, one resolved and typed tree out."""
