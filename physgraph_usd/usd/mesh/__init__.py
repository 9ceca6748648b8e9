"""Meshes of stages without pxr: what follows a mesh, shells, attributes, and surfaces as renderers draw them."""
