"""Warnings and notes of a run: `table` holds all of them; the other modules measure cloth and bodies for its tests."""
