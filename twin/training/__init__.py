"""Data sets and training of the connector detector; above plant and stack, used by the CLI alone."""
