"""Findings about a shot and its run: `table` holds every warning and note, the other modules measure what they need."""
