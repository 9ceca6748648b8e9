"""Reads garments, bodies, fabrics and times of a stage, as arrays in metres."""
