"""The solver's numbers: found in its code, counted by room, and changed in a running process.

A number is a numeric constant that a module of the solver names in capitals at its top level, or the numeric default,
other than 0, of a dataclass's field. Elements of a tuple, and names that are assigned together, count one by one.
Numbers in tables (dicts, fabrics), numbers computed from other names, and numbers inside functions do not count.
"""

from __future__ import annotations

import ast
import importlib
import math
import operator
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physgraph_usd.shot.options import RefineOptions

PACKAGE = "physgraph_usd.solver"
ROUND_CONTACT = ("contact", "collide")
_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.LShift: operator.lshift,
}


@dataclass(frozen=True)
class Number:
    """A number of the solver.

    Attributes:
        module: Name of the module.
        name: Name of the constant, or ``Class.field``.
        element: Number of the tuple's element, or None.
        value: Value.
        fixed: Reason why a running process cannot change the number; empty if it can.
        importers: Other modules that import the constant by name.
    """

    module: str
    name: str
    element: int | None
    value: float
    fixed: str = ""
    importers: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The name, with the element's number."""
        return self.name if self.element is None else f"{self.name}[{self.element}]"

    @property
    def file(self) -> str:
        """Path of the module below the solver."""
        return self.module.removeprefix(f"{PACKAGE}.").replace(".", "/") + ".py"

    @property
    def room(self) -> str:
        """Folder of the module below the solver, or the module itself."""
        return self.module.removeprefix(f"{PACKAGE}.").partition(".")[0]

    @property
    def variants(self) -> dict[str, float]:
        """Half and double; of a whole number at least 1. A variant equal to the value is left out."""
        if self.fixed:
            return {}
        half = max(1, self.value // 2) if isinstance(self.value, int) else 0.5 * self.value
        return {name: each for name, each in (("half", half), ("double", 2 * self.value)) if each != self.value}


def value_of(node: ast.AST) -> float | None:
    """Value of an expression written of numbers only, perhaps within calls of one argument; None for any other."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, int | float) and not isinstance(node.value, bool) else None
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        inner = value_of(node.operand)
        return None if inner is None else -inner
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        left, right = value_of(node.left), value_of(node.right)
        return None if left is None or right is None else _OPERATORS[type(node.op)](left, right)
    if isinstance(node, ast.Call) and len(node.args) == 1:
        return _called(ast.unparse(node.func), node.args[0])
    text = ast.unparse(node)
    return getattr(math, text.removeprefix("math.")) if text in ("math.pi", "math.inf") else None


def _called(function: str, argument: ast.expr) -> float | None:
    """Value of a call: of a function of `math`, of ``float("inf")``, or of a type, which keeps the value."""
    if function == "float" and isinstance(argument, ast.Constant) and argument.value == "inf":
        return math.inf
    inner = value_of(argument)
    if inner is None or not function.startswith("math."):
        return inner
    return getattr(math, function.removeprefix("math."))(inner)


def numbers_in(root: Path) -> list[Number]:
    """All numbers of a checkout's solver, by file."""
    folder = root / "physgraph_usd" / "solver"
    files = sorted(file for file in folder.rglob("*.py") if file.name != "__init__.py")
    trees = {
        ".".join([PACKAGE, *file.relative_to(folder).with_suffix("").parts]): ast.parse(file.read_text("utf-8"))
        for file in files
    }
    imported = {module: _imports(module, tree) for module, tree in trees.items()}
    fixed = {module: _fixed_names(tree) for module, tree in trees.items()}
    found = []
    for module, tree in trees.items():
        for name, element, value, label in _assigned(tree):
            importers = tuple(each for each, names in imported.items() if (module, name) in names)
            reasons = [fixed[each][name] for each in (module, *importers) if name in fixed[each]]
            reason = label or next(iter(reasons), "")
            found.append(Number(module, name, element, value, reason, importers))
        found += [Number(module, name, None, value) for name, value in _fields(tree)]
    return found


def counts(numbers: Sequence[Number]) -> Counter[str]:
    """Numbers by room."""
    return Counter(number.room for number in numbers)


def _assigned(tree: ast.Module) -> Iterator[tuple[str, int | None, float, str]]:
    """Name, element, value and label of each constant of a module; the label says why it is no quantity."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                if isinstance(target, ast.Name) and target.id.isupper():
                    yield from _elements(target.id, node.value)
                elif isinstance(target, ast.Tuple):
                    yield from _together(target, node.value)


def _elements(name: str, value: ast.expr) -> Iterator[tuple[str, int | None, float, str]]:
    if isinstance(value, ast.Tuple):
        each = [value_of(part) for part in value.elts]
        yield from ((name, k, number, "") for k, number in enumerate(each) if number is not None)
    elif (number := value_of(value)) is not None:
        kernel = "warp constant" if "wp.constant" in ast.unparse(value) else ""
        yield name, None, number, kernel or ("infinite" if math.isinf(number) else "")


def _together(target: ast.Tuple, value: ast.expr) -> Iterator[tuple[str, int | None, float, str]]:
    """Names assigned together, from a tuple, or numbered by a range."""
    if isinstance(value, ast.Tuple):
        for each, part in zip(target.elts, value.elts, strict=True):
            if isinstance(each, ast.Name) and each.id.isupper():
                yield from _elements(each.id, part)
    elif "range(" in ast.unparse(value):
        names = [each.id for each in target.elts if isinstance(each, ast.Name)]
        yield from ((name, None, number, "a label") for number, name in enumerate(names) if name.isupper())


def _fields(tree: ast.Module) -> Iterator[tuple[str, float]]:
    """Numeric defaults, other than 0, of the dataclasses of a module."""
    for owner in tree.body:
        if isinstance(owner, ast.ClassDef) and any("dataclass" in ast.unparse(each) for each in owner.decorator_list):
            for node in owner.body:
                if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
                    value = value_of(node.value)
                    if value:
                        yield f"{owner.name}.{node.target.id}", value


def _imports(module: str, tree: ast.Module) -> set[tuple[str, str]]:
    """Source module and name of each imported name."""
    found = set()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            base = module.split(".")[: -node.level] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            found |= {(source, each.name) for each in node.names}
    return found


def _fixed_names(tree: ast.Module) -> dict[str, str]:
    """Names whose change would not reach all their uses in a module, and the reason for each."""
    loaded = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    found = dict.fromkeys(_names(loaded), "read when the module loads")
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            defaults = [*node.args.defaults, *(each for each in node.args.kw_defaults if each)]
            found |= dict.fromkeys(_names(defaults), "a default argument")
        elif isinstance(node, ast.ClassDef):
            defaults = [each.value for each in node.body if isinstance(each, ast.AnnAssign) and each.value]
            found |= dict.fromkeys(_names(defaults), "a default argument")
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any("wp." in ast.unparse(each) for each in node.decorator_list):
            found |= dict.fromkeys(_names(node.body), "in a kernel")
    return found


def _names(nodes: Sequence[ast.AST]) -> set[str]:
    return {each.id for node in nodes for each in ast.walk(node) if isinstance(each, ast.Name)}


@contextmanager
def changed(number: Number, value: float) -> Iterator[None]:
    """Give a number another value in every module that uses the number, for as long as the context lasts."""
    module = importlib.import_module(number.module)
    if "." in number.name:
        owner, field = number.name.split(".")
        with _other_default((getattr(module, owner), RefineOptions), field, value):
            yield
        return
    old = getattr(module, number.name)
    new = value if number.element is None else tuple(value if k == number.element else v for k, v in enumerate(old))
    users = [module, *(sys.modules[each] for each in number.importers if each in sys.modules)]
    try:
        for each in users:
            setattr(each, number.name, new)
        yield
    finally:
        for each in users:
            setattr(each, number.name, old)


@contextmanager
def _other_default(classes: Sequence[type], field: str, value: float) -> Iterator[None]:
    """Give a field of dataclasses another default; classes without the field, or with another default, stay."""
    default = getattr(classes[0], field)
    makers: list[Any] = [each.__init__ for each in classes if getattr(each, field, None) == default]
    kept = [each.__defaults__ or () for each in makers]
    try:
        for each, old in zip(makers, kept, strict=True):
            names = each.__code__.co_varnames[: each.__code__.co_argcount][-len(old) :]
            each.__defaults__ = tuple(value if n == field else known for n, known in zip(names, old, strict=True))
        yield
    finally:
        for each, old in zip(makers, kept, strict=True):
            each.__defaults__ = old
