"""Detection: what is near what, and what would touch on its way. Positions in, answers out; nothing is remembered."""
