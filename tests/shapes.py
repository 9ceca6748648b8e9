"""Checks the tensor shapes that annotations promise, in every call that a test makes.

jaxtyping's own import hook would also wrap Warp kernels, which must stay the source that Warp reads; so the
functions are wrapped after the import, where a kernel is an object of Warp's and no function any more.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from types import FunctionType, ModuleType
from typing import Any

from beartype import beartype
from jaxtyping import jaxtyped


def check_shapes(package: str) -> int:
    """Wrap the annotated functions and methods of the package's imported modules; the number wrapped."""
    modules = [module for name, module in list(sys.modules.items()) if f"{name}.".startswith(f"{package}.")]
    checked: dict[Callable[..., Any], Callable[..., Any]] = {}
    for module in modules:
        for owner, name, function in _own_functions(module):
            checked[function] = jaxtyped(typechecker=beartype)(function)
            setattr(owner, name, checked[function])
    for module in modules:
        for name, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value in checked:
                setattr(module, name, checked[value])
    return len(checked)


def _own_functions(module: ModuleType) -> Iterator[tuple[ModuleType | type, str, FunctionType]]:
    classes = [cls for cls in vars(module).values() if inspect.isclass(cls) and cls.__module__ == module.__name__]
    for owner in (module, *classes):
        for name, value in list(vars(owner).items()):
            own = isinstance(value, FunctionType) and value.__module__ == module.__name__
            if own and any("Tensor" in str(hint) for hint in value.__annotations__.values()):
                yield owner, name, value
