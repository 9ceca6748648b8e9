"""A shot, from stage to layer: where reading, solving and writing meet."""
