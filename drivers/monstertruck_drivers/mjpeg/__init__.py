"""Motion JPEG from a program's output or over the network."""
