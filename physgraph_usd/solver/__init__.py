"""Cloth and its physics, without USD: a `scene.Scene` and its frames in, positions out."""
