"""Checking: the rules that a refined layer must keep."""
