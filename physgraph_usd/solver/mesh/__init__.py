"""Polygon meshes: topology, subdivision and the attributes that ride along."""
