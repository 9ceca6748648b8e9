"""Tuning a garment's values by hand while one frame is solved again and again: a session, its thread, and a page."""
