"""Digital twin of a flexible machining cell."""

__version__ = "0.1.0"
