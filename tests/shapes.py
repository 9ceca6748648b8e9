"""Checks the tensor shapes that annotations promise, in every call that a test makes.

jaxtyping's own import hook would also wrap Warp kernels, which must stay the source that Warp reads; so the
functions are wrapped after the import, where a kernel is an object of Warp's and no function any more. Whether a call
keeps its promise depends on types and shapes alone, so that each combination of them is checked once.
"""

import inspect
import sys
from collections.abc import Callable, Hashable, Iterator, Mapping
from functools import wraps
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from beartype import beartype
from jaxtyping import jaxtyped
from torch import Tensor


def check_shapes(package: str) -> int:
    """Wrap the annotated functions and methods of the package's imported modules; the number wrapped."""
    modules = [module for name, module in list(sys.modules.items()) if f"{name}.".startswith(f"{package}.")]
    checked: dict[Callable[..., Any], Callable[..., Any]] = {}
    for module in modules:
        for owner, name, function in _own_functions(module):
            checked[function] = _checked(function)
            setattr(owner, name, checked[function])
    for module in modules:
        for name, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value in checked:
                setattr(module, name, checked[value])
    return len(checked)


def _checked(function: FunctionType) -> Callable[..., Any]:
    """The function, which fails where a call breaks what is annotated."""
    promise, results = _promise_of(function)
    kept: set[Hashable] = set()

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        kinds = _kind((args, kwargs, result))
        if kinds not in kept:
            results.append(result)
            promise(*args, **kwargs)
            kept.add(kinds)
        return result

    return call


def _promise_of(function: FunctionType) -> tuple[Callable[..., Any], list[Any]]:
    """A function of the same parameters that is checked and gives what it takes from a list; and the list."""
    empty = inspect.Parameter.empty
    signature = inspect.signature(function)
    bare = [each.replace(annotation=empty, default=empty) for each in signature.parameters.values()]
    bare = signature.replace(parameters=bare, return_annotation=inspect.Signature.empty)
    # A module that the start of a command pays for imports Tensor for type checkers alone.
    scope: dict[str, Any] = {"Tensor": Tensor, **function.__globals__, "results": (results := [])}
    exec(f"def promise{bare}: return results.pop()", scope)
    promise = scope["promise"]
    promise.__annotations__ = {name: hint for name, hint in function.__annotations__.items() if "Tensor" in str(hint)}
    promise.__qualname__ = function.__qualname__
    promise.__defaults__, promise.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    return jaxtyped(typechecker=beartype)(promise), results


def _kind(value: Any) -> Hashable:
    """All of a value that annotations speak of."""
    if isinstance(value, (Tensor, np.ndarray)):
        return value.dtype, tuple(value.shape)
    if isinstance(value, (tuple, list)):
        return type(value), *map(_kind, value)
    if isinstance(value, Mapping):
        return type(value), *((name, _kind(each)) for name, each in value.items())
    return value if isinstance(value, str) else type(value)


def _own_functions(module: ModuleType) -> Iterator[tuple[ModuleType | type, str, FunctionType]]:
    classes = [cls for cls in vars(module).values() if inspect.isclass(cls) and cls.__module__ == module.__name__]
    for owner in (module, *classes):
        for name, value in list(vars(owner).items()):
            own = isinstance(value, FunctionType) and value.__module__ == module.__name__
            if own and any("Tensor" in str(hint) for hint in value.__annotations__.values()):
                yield owner, name, value
