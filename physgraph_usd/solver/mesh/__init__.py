"""Polygon meshes: topology and subdivision."""
