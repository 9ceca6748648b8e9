"""Writes layers, primvars and samples; a file is complete or absent."""
