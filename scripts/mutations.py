"""Small faults that a mutation check plants in Python source, one at a time (see `scripts/mutants.py`).

Comparisons flip and move their boundary, operators swap, terms go, constants move, signs and conditions turn, extremes
change sides, elementwise calls and dropped arguments go, a function returns its argument. Texts are left alone: what
is printed is not mathematics.
"""

from __future__ import annotations

import ast
import copy
import hashlib
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

COMPARE: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_PAIRS = (
    ("min", "max"),
    ("minimum", "maximum"),
    ("amin", "amax"),
    ("argmin", "argmax"),
    ("cummin", "cummax"),
    ("clamp_min", "clamp_max"),
    ("any", "all"),
    ("zeros_like", "ones_like"),
    ("sum", "mean"),
)
NAMES = {a: b for pair in _PAIRS for a, b in (pair, pair[::-1])}
# elementwise methods and functions of one argument, in whose place the argument is passed on
ELEMENTWISE = {"square", "sqrt", "sqrt_", "rsqrt", "abs", "exp", "log", "log1p", "reciprocal", "detach", "cumsum"}
ELEMENTWISE |= {"clamp", "clamp_min", "clamp_max", "nan_to_num", "addcmul", "addcmul_", "add_", "sub_", "deg2rad"}
ELEMENTWISE |= {"rad2deg", "erfc", "asin", "expand", "sort"}


class Mutant(NamedTuple):
    """One fault.

    Attributes:
        key: the same as long as its function's text is: of module, function, what becomes what, and which of equals.
        module: dotted name.
        function: dotted name within the module, empty outside functions.
        line: of the source.
        first: first line of its statement, or of its function for an argument's default; 0 outside functions.
        last: the last one: tests that run any of them may notice.
        change: old text -> new text.
        path: fields and indices from the module's node to the one replaced.
        choice: which of that node's variants.
    """

    key: str
    module: str
    function: str
    line: int
    first: int
    last: int
    change: str
    path: tuple[str | int, ...]
    choice: int


def mutants_of(module: str, source: str) -> list[Mutant]:
    """All faults of a module's source, in the order of its lines."""
    found, seen = [], Counter[str]()
    for path, node, function, lines in _places(ast.parse(source), (), "", (0, 0)):
        for choice, new in enumerate(_variants(node, function)):
            change = f"{_text(node)} -> {_text(new)}"
            name = f"{module}:{function[0]}:{change}"
            seen[name] += 1
            key = hashlib.sha256(f"{name}:{seen[name]}".encode()).hexdigest()[:10]
            line = getattr(node, "lineno", lines[0])
            found.append(Mutant(key, module, function[0], line, *lines, change, path, choice))
    return sorted(found, key=lambda m: (m.line, m.path, m.choice))


def mutated(source: str, mutant: Mutant) -> ast.Module:
    """The module with the fault."""
    tree = ast.parse(source)
    holder: Any = tree
    arguments: tuple[str, ...] = ()
    for step in mutant.path[:-1]:
        holder = _step(holder, step)
        if isinstance(holder, ast.FunctionDef):
            arguments = _arguments(holder)
    node = _step(holder, mutant.path[-1])
    new = list(_variants(node, (mutant.function, arguments)))[mutant.choice]
    ast.copy_location(new, node)
    if isinstance(mutant.path[-1], int):
        holder[mutant.path[-1]] = new
    else:
        setattr(holder, mutant.path[-1], new)
    return ast.fix_missing_locations(tree)


def _step(node: Any, step: str | int) -> Any:
    return node[step] if isinstance(step, int) else getattr(node, step)


def _text(node: ast.AST) -> str:
    text = " ".join(ast.unparse(node).split())
    return text if len(text) < 90 else text[:60] + " ... " + text[-25:]


def _arguments(node: ast.FunctionDef) -> tuple[str, ...]:
    return tuple(a.arg for a in (*node.args.args, *node.args.kwonlyargs) if a.arg not in ("self", "cls"))


_Arguments = tuple[str, ...]
_Function = tuple[str, _Arguments]
_Place = tuple[tuple[str | int, ...], ast.AST, _Function, tuple[int, int]]


def _places(
    node: ast.AST, path: tuple[str | int, ...], name: str, lines: tuple[int, int], arguments: _Arguments | None = None
) -> Iterator[_Place]:
    """Every node that may be mutated, with the function that it belongs to and the lines that show whether it ran."""
    if isinstance(node, ast.stmt):
        body = getattr(node, "body", None)
        last = node.end_lineno or node.lineno
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            name = f"{name}.{node.name}" if name else node.name
            if isinstance(node, ast.FunctionDef):
                lines = (node.lineno, last)
                arguments = _arguments(node)
        elif arguments is not None:
            lines = (node.lineno, body[0].lineno - 1 if body else last)
    yield path, node, (name, arguments or ()), lines
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "bases", "type_params", "ctx", "ops", "op", "func"):
            if field != "func" or not isinstance(node.func, ast.Attribute):  # type: ignore[attr-defined]
                continue
        for k, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(child, ast.AST) and not _left_alone(node, field, k, child):
                here = (*path, field) if k is None else (*path, field, k)
                yield from _places(child, here, name, lines, arguments)


def _left_alone(node: ast.AST, field: str, k: int | None, child: ast.AST) -> bool:
    """Texts, imports, types and messages."""
    if isinstance(child, ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Raise):
        return True
    if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
        return True  # a docstring
    if isinstance(child, ast.keyword) and child.arg == "strict":
        return True  # of zip: a guard
    if isinstance(child, ast.Assign) and any(_text(t) in ("__all__", "Generators", "Common") for t in child.targets):
        return True
    if isinstance(child, ast.Assign) and _text(child.value).startswith(("Sequence[", "tuple[", "Tensor |")):
        return True
    is_require = isinstance(node, ast.Call) and _text(node.func).endswith("require")
    return is_require and field == "args" and k is not None and k > 0


def _variants(node: ast.AST, function: _Function) -> Iterator[ast.AST]:
    """What may stand in a node's place."""
    match node:
        case ast.Compare():
            for k, op in enumerate(node.ops):
                for other in COMPARE[type(op)]:
                    new = copy.deepcopy(node)
                    new.ops[k] = other()
                    yield new
        case ast.BinOp() if type(node.op) in OPERATORS and not _is_text(node.left) and not _is_text(node.right):
            yield ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right)
            if isinstance(node.op, ast.Add | ast.Sub | ast.Pow):
                yield node.left
            if isinstance(node.op, ast.Add):
                yield node.right
        case ast.AugAssign() if type(node.op) in OPERATORS:
            yield ast.AugAssign(node.target, OPERATORS[type(node.op)](), node.value)
        case ast.UnaryOp() if isinstance(node.op, ast.USub | ast.Not | ast.Invert):
            yield node.operand
        case ast.BoolOp():
            yield ast.BoolOp(ast.And() if isinstance(node.op, ast.Or) else ast.Or(), node.values)
        case ast.Constant(value=bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(value=int()):
            yield ast.Constant(node.value + 1)
        case ast.Constant(value=float()):
            yield ast.Constant(2 * node.value if node.value else 1.0)
        case ast.IfExp():
            yield ast.IfExp(node.test, node.orelse, node.body)
        case ast.If():
            yield ast.If(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
        case ast.comprehension(ifs=[_, *_]):
            yield ast.comprehension(node.target, node.iter, [], node.is_async)
        case ast.Return(value=ast.AST()) if function[1]:
            if not (isinstance(node.value, ast.Name) and node.value.id == function[1][0]):
                yield ast.Return(ast.Name(function[1][0], ast.Load()))
        case ast.Call():
            yield from _calls(node)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _calls(node: ast.Call) -> Iterator[ast.AST]:
    function = node.func
    name = str(getattr(function, "attr", getattr(function, "id", "")))
    if name in NAMES:
        new = copy.deepcopy(node)
        if isinstance(new.func, ast.Attribute):
            new.func.attr = NAMES[name]
        elif isinstance(new.func, ast.Name):
            new.func.id = NAMES[name]
        yield new
    if name in ("clamp", "nan_to_num") and node.keywords and node.keywords[0].arg in ("min", "max"):
        yield ast.Call(function, node.args, [ast.keyword(NAMES[str(k.arg)], k.value) for k in node.keywords])
    if name == "where" and len(node.args) == 3:
        yield ast.Call(function, [node.args[0], node.args[2], node.args[1]], node.keywords)
    if name in ELEMENTWISE and isinstance(function, ast.Attribute):
        module = isinstance(function.value, ast.Name) and function.value.id in ("torch", "math")
        yield node.args[0] if module else function.value
