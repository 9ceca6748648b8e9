"""Writes a layer piece by piece and releases the written parts from memory.

Author through ``Sdf``, not through a stage: nothing is composed, so a time sample costs no more than a copy.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

from pxr import Sdf, Tf

from ...errors import LayerError
from ...interrupts import leave_if_asked
from ..files import LAYER_SUFFIXES, check_suffix
from ..stage import reason_of
from .atomic import prepare_target, publish, temporary_path

IN_MEMORY = "refined.usda"
"""Name of a layer in memory."""
FLUSH_BYTES = 16_000_000
"""Pending array bytes before the layer is saved; each save rewrites a few kilobytes of tables."""


class LayerStream:
    """A new layer, written atomically and in pieces, or in memory.

    Values go to a temporary binary layer beside the target; `commit` moves the layer to the final name, converting to
    text for a ``.usda`` target. Leaving the ``with`` block without `commit` removes the temporary file. A layer without
    a target is anonymous, stays in memory and touches no disk.
    """

    def __init__(self, target: Path | None, *, overwrite: bool = False) -> None:
        """Start a temporary layer, or an in-memory layer.

        Args:
            target: Final path, ``.usdc``, ``.usda`` or ``.usd``; None for a layer in memory.
            overwrite: Whether an existing file may be replaced, at `commit`.

        Raises:
            UsageError: The extension is not a layer's, or the target exists and may not be replaced.
            LayerError: The folder cannot be written, or this process is writing the same layer already.
        """
        self.target = target
        self.temporary = None if target is None else temporary_path(target)
        self._pending = 0
        self._layer: Sdf.Layer | None = Sdf.Layer.CreateAnonymous(IN_MEMORY) if target is None else None
        if target is not None and self.temporary is not None:
            self._layer = self._created(target, self.temporary, overwrite=overwrite)

    def _created(self, target: Path, temporary: Path, *, overwrite: bool) -> Sdf.Layer:
        check_suffix("the layer", target, LAYER_SUFFIXES)
        if Sdf.Layer.Find(str(temporary)):
            raise LayerError(f"{target} is being written by this process already")
        prepare_target(target, overwrite=overwrite)
        try:
            layer = Sdf.Layer.CreateNew(str(temporary))
        except Tf.ErrorException as error:
            raise self._failure(error) from error
        if layer is None:
            raise LayerError(f"cannot write in {target.parent}: check that the folder is writable")
        return layer

    @property
    def layer(self) -> Sdf.Layer:
        """The layer being written.

        Raises:
            LayerError: The layer is already committed or discarded.
        """
        if self._layer is None:
            raise LayerError(f"{self.target} is closed; nothing more can be written to it")
        return self._layer

    def prim(self, path: Sdf.Path) -> Sdf.PrimSpec:
        """The ``over`` at a path, created with its ancestors if missing."""
        return self.layer.GetPrimAtPath(path) or Sdf.CreatePrimInLayer(self.layer, path)

    def attribute(
        self, path: Sdf.Path, type_name: Sdf.ValueTypeName, *, uniform: bool = False, interpolation: str = ""
    ) -> Sdf.AttributeSpec:
        """The attribute spec at a path, created if missing; ``interpolation`` is authored as metadata, if any."""
        spec = self.layer.GetAttributeAtPath(path)
        if spec is None:
            variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
            spec = Sdf.AttributeSpec(self.prim(path.GetPrimPath()), path.name, type_name, variability)
        if interpolation:
            spec.SetInfo("interpolation", interpolation)
        return spec

    def set(self, path: Sdf.Path, value: Any, *, time: float | None = None) -> None:
        """Author a value, a ``Vt`` array or a plain value, of an existing attribute spec; LayerError on a full disk."""
        if time is None:
            self.layer.GetAttributeAtPath(path).default = value
        else:
            self.layer.SetTimeSample(path, time, value)
        self._pending += _size(value)
        if self._pending >= FLUSH_BYTES:
            self.flush()

    def block(self, path: Sdf.Path, type_name: Sdf.ValueTypeName) -> None:
        """Hide all weaker values of an attribute, including samples."""
        self.attribute(path, type_name).default = Sdf.ValueBlock()

    def flush(self) -> None:
        """Save pending values and release their memory.

        Raises:
            LayerError: The disk is full or gone.
            KeyboardInterrupt, SystemExit: A signal asks the run to end.
        """
        leave_if_asked()
        if self.target is not None:
            try:
                saved = self.layer.Save()
            except Tf.ErrorException as error:
                raise self._failure(error) from error
            if not saved:
                raise LayerError(f"cannot write {self.target}: saving failed without a reason")
        self._pending = 0

    def commit(self) -> Path | None:
        """Move the layer to its final path, and return the path; None for an in-memory layer, still in ``layer``.

        Raises:
            LayerError: The disk is full, or the target is held open by another program.
        """
        self.flush()
        if self.target is None or self.temporary is None:
            return None
        finished = self._as_text(self.target) if self.target.suffix == ".usda" else self.temporary
        # Windows cannot move a memory-mapped layer.
        self._layer = None
        publish(finished, self.target)
        self.discard()
        loaded = Sdf.Layer.Find(str(self.target))
        if loaded:
            loaded.Reload(True)
        return self.target

    def _as_text(self, target: Path) -> Path:
        path = temporary_path(target, suffix=".usda")
        try:
            self.layer.Export(str(path))
        except Tf.ErrorException as error:
            path.unlink(missing_ok=True)
            raise self._failure(error) from error
        return path

    def discard(self) -> None:
        """Remove the temporary file, if present; an in-memory layer stays."""
        if self.temporary is None:
            return
        self._layer = None
        self.temporary.unlink(missing_ok=True)

    def _failure(self, error: Tf.ErrorException) -> LayerError:
        """An error with the reason of a failed save, in one line."""
        reasons = reason_of(error).split("; ")
        # Some versions report unrelated trouble first, such as a plugin that failed to load.
        reason = next((text for text in reasons if "writ" in text.lower()), reasons[0])
        return LayerError(f"cannot write {self.target}: {reason}; nothing was left under that name")

    def __enter__(self) -> LayerStream:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the temporary file unless committed."""
        self.discard()


def _size(value: Any) -> int:
    """Bytes of an array value, or a small number."""
    try:
        return memoryview(value).nbytes
    except TypeError:
        return 64 * len(value) if hasattr(value, "__len__") else 64
