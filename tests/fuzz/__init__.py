"""Mutates stages and sees that every mutant ends in a valid layer or an error of our tree: ``python -m tests.fuzz``."""
