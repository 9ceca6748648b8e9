"""How a collider's side is told, by name; apart so that naming one loads nothing."""

SIDES = ("auto", "winding", "start", "front", "back")
"""How to tell on which side of a mesh cloth belongs.

"auto": outside of pieces that are closed, and of the others the side on which the coarse cloth around a vertex is.
"winding": outside of every piece, closed or not, by the generalised winding number.
"start": the side on which the coarse cloth is, of every piece, closed or not.
"front", "back": that side of the authored faces of open pieces; outside of closed ones.
"""
