"""The camera of the page: framed on the garments, and as the artist left it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser

from ..shot.page.drawing import framed
from .desk import in_order
from .picture import Picture

FIELD = np.radians(30.0)
"""Field of view across the picture's height [rad]: a long lens, as for garments in a catalogue."""
ROOM = 0.92
"""Fraction of the picture's width or height, whichever is fuller, filled by framed garments."""
ASPECT = 1.17
"""Width of the picture in heights, until the browser has told it."""
ABOVE = 0.18
"""Height of the first camera above the garments' middle, in its distance: the ground is seen."""
DOUBLE_SECONDS = 0.4
"""Longest time between the two clicks of a double click."""


class Camera:
    """The cameras of the browsers that show the page.

    Attributes:
        last: Position, place looked at and direction upwards of the last change, as lists of numbers; or None.
    """

    def __init__(self, server: viser.ViserServer, picture: Picture, last: Mapping[str, list[float]] | None) -> None:
        """Look as ``last``, or at the garments; F and double clicks frame them."""
        self.last = None if last is None else dict(last)
        self._server, self._picture, self._clicked = server, picture, 0.0
        _, up, front = picture.axes
        self._back = front + ABOVE * up
        position, middle = self.fit(self._back, ASPECT)
        server.scene.set_up_direction(tuple(up.tolist()))
        initial = server.initial_camera
        initial.position, initial.look_at, initial.fov = position, middle, FIELD
        server.on_client_connect(in_order(self._welcome))
        command = server.gui.add_command("Frame the garments", hotkey="F")
        command.on_trigger(in_order(lambda event: self._frame(event.client)))

    def on_click(self, clicked: Callable[[Any], None]) -> None:
        """Have a function called with viser's event of each click in the picture that is no double click's second."""

        def called(event: Any) -> None:
            before, self._clicked = self._clicked, time.monotonic()
            if self._clicked - before < DOUBLE_SECONDS:
                self._frame(event.client)
            else:
                clicked(event)

        scene: Any = self._server.scene  # Its stub does not know of coroutines.
        scene.on_click()(in_order(called))

    @property
    def eye(self) -> np.ndarray:
        """Position of the camera that changed last [m], shape (3,)."""
        return np.asarray(self._server.initial_camera.position if self.last is None else self.last["position"])

    def frame(self) -> None:
        """Frame the garments in every browser."""
        for client in self._server.get_clients().values():
            self._frame(client)

    def fit(self, back: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
        """The camera's position and the place looked at [m], each of shape (3,), at which the garments fit.

        Args:
            back: Direction from the garments to the camera, shape (3,).
            aspect: Width of the picture over its height.
        """
        back = back / np.linalg.norm(back)
        right = np.cross(self._picture.axes[1], back)
        right = right / np.linalg.norm(right)
        axes = np.stack([right, np.cross(back, right), back])
        middle, distance = framed(self._picture.framed @ axes.T, aspect, room=ROOM * np.tan(0.5 * FIELD))
        return middle @ axes + distance * back, middle @ axes

    def _frame(self, client: Any, back: np.ndarray | None = None) -> None:
        """Frame the garments, seen from where the camera is, or from a direction."""
        camera = client.camera
        back = np.asarray(camera.position) - np.asarray(camera.look_at) if back is None else back
        position, middle = self.fit(back, _aspect(camera))
        with client.atomic():
            camera.position, camera.look_at = position, middle

    def _welcome(self, client: Any) -> None:
        """Set the camera of a browser that connects, between two of its messages.

        A message in between would undo a part on viser's side, and viser sends no part that it takes for known.
        """
        if self.last:
            for name, value in self.last.items():
                setattr(client.camera, name, value)
        else:  # The browser tells its own camera before it has ours.
            self._frame(client, self._back)
        framed = {} if self.last else {"at": client.camera.position.copy(), "aspect": _aspect(client.camera)}

        def seen(camera: Any) -> None:
            still = framed and np.allclose(camera.position, framed["at"], rtol=1e-3)
            if still and framed["aspect"] != _aspect(camera):  # The panel, which docks later, leaves less room.
                self._frame(client, self._back)
                framed.update(at=camera.position.copy(), aspect=_aspect(camera))
            found = {name: getattr(camera, name) for name in ("position", "look_at", "up_direction")}
            self.last = {name: [float(each) for each in value] for name, value in found.items()}

        client.camera.on_update(in_order(seen))


def _aspect(camera: Any) -> float:
    """Width of a browser's picture over its height."""
    return camera.image_width / max(camera.image_height, 1)
