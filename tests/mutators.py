"""The mutants of a module: one small change each, of its syntax tree. `mutation.py` runs the tests on them."""

import ast
import copy
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

OTHERS: dict[type, tuple[type, ...]] = {
    **{ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt)},
    **{ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,)},
    **{ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.And: (ast.Or,), ast.Or: (ast.And,)},
    **{ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.Pow: (ast.Mult,)},
    **{ast.FloorDiv: (ast.Mult,), ast.Mod: (ast.Mult,), ast.LShift: (ast.RShift,), ast.RShift: (ast.LShift,)},
    **{ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,), ast.BitXor: (ast.BitOr,)},
}
NAMES = {"min": "max", "minimum": "maximum", "any": "all", "floor": "ceil", "zeros": "ones", "argmin": "argmax"}
NAMES |= {new: old for old, new in NAMES.items()}
SAME = {"strict", "copy", "stacklevel"}  # arguments without effect on results


@dataclass
class Mutant:
    """A change of one place of a syntax tree; `apply` makes it, `undo` takes it back."""

    path: str
    function: str
    lines: range
    tree: ast.Module
    statement: ast.stmt
    parent: Any
    field: str
    place: int | None  # in a list
    node: Any
    new: Any

    def _put(self, node: Any) -> None:
        if self.place is None:
            setattr(self.parent, self.field, node)
        else:
            getattr(self.parent, self.field)[self.place] = node

    def apply(self) -> ast.Module:
        self._put(ast.fix_missing_locations(ast.copy_location(self.new, self.node)))
        return self.tree

    def undo(self) -> None:
        self._put(self.node)

    def key(self) -> tuple[str, str, str, str]:
        """Return path, function, and the first line that differs, without and with the change; a long one is cut."""
        old, new = self._lines()
        start = max(len(os.path.commonprefix([old, new])) - 60, 0)
        end = max(len(os.path.commonprefix([old[start + 60 :][::-1], new[start + 60 :][::-1]])) - 60, 0)
        return self.path, self.function, old[start : len(old) - end].strip(), new[start : len(new) - end].strip()

    def _lines(self) -> tuple[str, str]:
        holder = ast.Module([self.statement], [])  # a statement that is dropped is replaced here, not in its parent
        before = ast.unparse(holder).splitlines()
        if self.node is self.statement:
            return before[0], ast.unparse(self.new).splitlines()[0]
        self.apply()
        after = ast.unparse(holder).splitlines()
        self.undo()
        return next((old.strip(), new.strip()) for old, new in zip(before, after, strict=False) if old != new)


def mutants_of(root: Path, path: str) -> list[Mutant]:
    """Return all mutants of a module, in the order of its text."""
    tree = ast.parse((root / path).read_text())
    return list(_walk(path, tree, tree, "", tree))


def _walk(path: str, tree: ast.Module, parent: Any, function: str, statement: Any) -> Iterator[Mutant]:
    for field, value in ast.iter_fields(parent):
        if field in ("annotation", "returns", "decorator_list", "bases"):
            continue
        for place, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(node, ast.AST) or _is_text(node):
                continue
            here = node if isinstance(node, ast.stmt) else statement
            lines = range(getattr(node, "lineno", 0), (getattr(node, "end_lineno", 0) or 0) + 1)
            for new in _changes(node):
                yield Mutant(path, function, lines, tree, here, parent, field, place, node, new)
            named = isinstance(node, ast.FunctionDef | ast.ClassDef)
            name = f"{function}.{node.name}".lstrip(".") if named else function
            yield from _walk(path, tree, node, name, here)


def _is_text(node: ast.AST) -> bool:
    """Return whether nothing under a node changes results: messages, imports, text, lists of names."""
    if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return True
    if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
        return True
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True
    return isinstance(node, ast.keyword) and node.arg in SAME


def _with(node: Any, **fields: Any) -> Any:
    changed = copy.copy(node)
    for field, value in fields.items():
        setattr(changed, field, value)
    return changed


def _changes(node: Any) -> Iterator[Any]:
    """Return what may stand in the place of a node."""
    match node:
        case ast.Compare():
            for n, op in enumerate(node.ops):
                for other in OTHERS[type(op)]:
                    yield _with(node, ops=[*node.ops[:n], other(), *node.ops[n + 1 :]])
        case ast.BinOp(ast.Constant(0)) | ast.BinOp(_, _, ast.BinOp(ast.Constant(0))):
            pass  # + 0 * x gives a shape, whatever the operators
        case ast.BinOp() | ast.BoolOp() if type(node.op) in OTHERS:
            for other in OTHERS[type(node.op)]:
                yield _with(node, op=other())
        case ast.UnaryOp(ast.Not() | ast.USub() | ast.Invert()):
            yield node.operand
        case ast.Constant(bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(int()):
            yield ast.Constant(node.value + 1)
        case ast.Constant(float()):  # a small one is a tolerance
            yield ast.Constant((1000.0 if node.value < 1e-3 else 1.3) * node.value or 1.0)
        case ast.If() | ast.IfExp() if not isinstance(node.test, ast.Compare | ast.UnaryOp):  # those are negated above
            yield _with(node, test=ast.copy_location(ast.UnaryOp(ast.Not(), node.test), node.test))
        case ast.Break():
            yield ast.Continue()
        case ast.Continue():
            yield ast.Break()
        case ast.AugAssign():
            yield ast.Pass()
            for other in OTHERS[type(node.op)]:
                yield _with(node, op=other())
        case ast.Expr(ast.Call()) | ast.Assign([ast.Subscript()]):
            yield ast.Pass()
        case ast.Call(ast.Name(name) as called) if name in NAMES:
            yield _with(node, func=_with(called, id=NAMES[name]))
        case ast.Call(ast.Attribute(_, name) as called) if name in NAMES:
            yield _with(node, func=_with(called, attr=NAMES[name]))
        case ast.Call(ast.Attribute(values, "clip")):
            yield values
        case ast.Call(ast.Name("abs") | ast.Attribute(_, "abs")):
            yield node.args[0]
