"""Collision detection, stateless: positions in; near pairs, crossings and pairs too near on a move out."""
