"""Deliberate defects of our own code, each of which the tests must catch: ``python -m tests.mutations``."""
