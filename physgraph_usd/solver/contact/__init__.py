"""Contact: who is near whom, the planes that stand for bodies and for cloth, and what crosses, before and after."""
