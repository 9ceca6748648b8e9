"""A shot from stage to layer: reading, solving and writing combined."""
