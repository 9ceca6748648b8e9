"""Polygon meshes: topology, subdivision and attributes."""
