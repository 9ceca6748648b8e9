"""Foreign solvers of the same problem, each behind an adapter run in a separate environment."""
