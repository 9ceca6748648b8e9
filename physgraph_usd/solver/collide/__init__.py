"""Collision detection: near pairs, and pairs that would touch on their paths. Stateless: positions in, pairs out."""
