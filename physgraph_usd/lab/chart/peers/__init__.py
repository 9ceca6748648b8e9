"""Foreign solvers of the same problem, each behind an adapter that runs in its own environment."""
