"""Scenarios without a plant, for the tests of the command line."""
