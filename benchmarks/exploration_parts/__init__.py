"""Parts of the exploration benchmark."""
