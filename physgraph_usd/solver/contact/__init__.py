"""Contact: pairs that are near, contact planes of bodies and of cloth, and intersections before and after the solve."""
