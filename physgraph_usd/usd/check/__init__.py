"""Checks refined layers against the rules."""
