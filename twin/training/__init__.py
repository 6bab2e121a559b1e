"""Data sets and training of the connector detector, above plant and stack; for the CLI alone."""
