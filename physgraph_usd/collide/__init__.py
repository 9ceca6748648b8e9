"""Detection: what is near what, what would touch on its way, what crosses. Positions in, answers out; nothing is kept."""
