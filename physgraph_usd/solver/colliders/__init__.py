"""Bodies that cloth rests on: closest points on moving meshes and on analytic shapes."""
