"""Contact is measured whether or not it is modelled, where a report is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from bodies import ball
from cloth import sheet
from touching import frame, measured, mesh_pose, refiner

from physgraph_usd.solver.contact.settings import ContactSettings
from physgraph_usd.solver.scene import State

MESH, REST = sheet(8, 8, 0.05)
HANGING = REST - REST.mean(axis=0)
NORMAL = np.eye(3)[np.ptp(HANGING, axis=0).argmin()]
BALL = ball(0.1)


def solved(contact: ContactSettings) -> State:
    """A sheet whose middle is in a ball."""
    solver = refiner((MESH, REST), temporal="off")
    solver.use(replace(solver._settings, contact=contact))
    return solver.solve(frame(HANGING, mesh_pose((BALL[0] - 0.09 * NORMAL, BALL[1]))))


def test_what_is_off_is_measured_and_changes_no_bit():
    off = ContactSettings("off", cloth="off")
    without, judged = solved(off), solved(replace(off, measured=True))
    assert "contact" not in without.telemetry[0]
    assert measured(judged, "before")["inside"] > 20
    assert measured(judged)["inside"] > 20
    assert measured(judged)["crossings"] > 20
    assert bool((np.asarray(without.points[0]) == np.asarray(judged.points[0])).all())
