"""Solvers that nobody here wrote, given the same problem: each by an adapter that runs in an environment of its own."""
