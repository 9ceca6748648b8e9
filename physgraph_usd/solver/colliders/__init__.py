"""Bodies in contact with cloth: closest points on moving meshes and on analytic shapes."""
