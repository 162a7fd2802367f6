"""Refuses identity comparisons in tasks: ``value is None`` is always false for a value that is known only while the task runs, and no object can overload ``is``.
Such comparisons are searched in the source of a task's function, before it is called.

Only comparisons of certain values are refused: a parameter of the task, the variable of ``ratn.each``, an output of a state, an expression of these; and a
name if everything assigned to it is such a value. Anything else (for example the result of a plain function that may return ``None``) is left alone.
"""

from __future__ import annotations

import ast
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

from ratn import _blocks, _expression, _states
from ratn._expression import Functions, function_at, refuse
from ratn._step import Step

_Kind = Literal["value", "state"]
#: Calls that make a state, and calls that make a value.
_STATES = (_states.wait, _states.ask, _states.action, _states.library)
_VALUES = (_expression.fact, _expression.expr, _expression.exists, _expression.isin, _states.variable, _blocks.collect)
_MAKE_VALUES = (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.MatMult, ast.BitAnd, ast.BitOr)


def refuse_identity(function: Callable[..., Any]) -> None:
    """Refuses the first identity comparison of a value that is known only while the task runs. Without the function's source nothing is refused."""
    code = function.__code__
    node = function_at(code.co_filename, code.co_firstlineno, code.co_name)
    if node is None:
        return
    names = {**function.__globals__, **_captured(function)}
    for text, condition, line in _Function(node, names).compared():
        refuse(
            f"`{text}` is decided by Python now, the same way whatever the value will be while the task runs",
            f"write `with ratn.when({condition}):`, or `fn.if_({condition}, a, b)`",
            (code.co_filename, line),
        )


def _captured(function: Callable[..., Any]) -> dict[str, Any]:
    """The variables that a function captures from its enclosing functions, as far as they are set already."""
    captured = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or ()):
        try:
            captured[name] = cell.cell_contents
        except ValueError:
            continue
    return captured


class _Function:
    """The source of a function, with the values given to each of its names."""

    def __init__(self, node: ast.FunctionDef, names: Mapping[str, Any]) -> None:
        self.node, self.names = node, names
        #: What is certainly given to a name: an expression, or a kind.
        self.given: dict[str, list[ast.expr | _Kind]] = {}
        #: How often a name is bound, in any way.
        self.bound: dict[str, int] = {}
        self.asked: set[str] = set()
        own = {id(argument) for argument in ast.walk(node.args) if isinstance(argument, ast.arg)}
        for part in ast.walk(node):
            for name in _bound_by(part):
                self.bound[name] = self.bound.get(name, 0) + 1
            if isinstance(part, ast.arg) and id(part) in own:
                self._gives(part.arg, "value")
        for part in ast.walk(node):
            self._read(part)

    def _gives(self, name: str, what: ast.expr | _Kind) -> None:
        self.given.setdefault(name, []).append(what)

    def _read(self, part: ast.AST) -> None:
        if isinstance(part, ast.Assign):
            for target in part.targets:
                if isinstance(target, ast.Name):
                    self._gives(target.id, part.value)
        elif isinstance(part, (ast.AnnAssign, ast.NamedExpr)) and isinstance(part.target, ast.Name) and part.value is not None:
            self._gives(part.target.id, part.value)
        elif isinstance(part, ast.For) and isinstance(part.iter, ast.Call) and self._called(part.iter.func) is _blocks.each:
            targets = part.target.elts if isinstance(part.target, ast.Tuple) else [part.target]
            for target in targets:
                if isinstance(target, ast.Name):
                    self._gives(target.id, "value")
        elif isinstance(part, ast.Call) and self._called(part.func) is Functions:
            for given in part.args:
                for argument in given.args.args if isinstance(given, ast.Lambda) else ():
                    self._gives(argument.arg, "value")

    def compared(self) -> Iterator[tuple[str, str, int]]:
        """Each identity comparison with `None` or a boolean: its text, the intended condition, and its line."""
        for part in ast.walk(self.node):
            if isinstance(part, ast.Compare):
                sides = [part.left, *part.comparators]
                for one, sign, other in zip(sides, part.ops, sides[1:]):
                    value, constant = (other, one) if isinstance(one, ast.Constant) else (one, other)
                    if not isinstance(sign, (ast.Is, ast.IsNot)) or not isinstance(constant, ast.Constant):
                        continue
                    if (constant.value is None or isinstance(constant.value, bool)) and self._kind(value) == "value":
                        yield ast.unparse(part), _condition(value, constant.value, isinstance(sign, ast.Is)), part.lineno
            elif isinstance(part, ast.Match) and self._kind(part.subject) == "value":
                for case in part.cases:
                    for pattern in ast.walk(case.pattern):
                        if isinstance(pattern, ast.MatchSingleton):
                            yield f"case {ast.unparse(pattern)}", _condition(part.subject, pattern.value, True), pattern.lineno

    def _kind(self, node: ast.expr) -> _Kind | None:
        """Whether an expression is certainly a value, or certainly a state."""
        if isinstance(node, ast.Name):
            return self._kind_of_name(node.id)
        if isinstance(node, ast.NamedExpr):
            return self._kind(node.value)
        if isinstance(node, (ast.Attribute, ast.Subscript)):
            is_private = isinstance(node, ast.Attribute) and node.attr.startswith("_")
            return "value" if self._kind(node.value) is not None and not is_private else None
        if isinstance(node, ast.BinOp) and isinstance(node.op, _MAKE_VALUES):
            return "value" if "value" in (self._kind(node.left), self._kind(node.right)) else None
        if isinstance(node, ast.Call):
            called = self._called(node.func)
            if isinstance(called, (Step, _states.Provider)) or any(called is one for one in _STATES):
                return "state"
            makes_value = isinstance(called, _states.TaskFunction) or any(called is one for one in (Functions, *_VALUES))
            return "value" if makes_value else None
        return None

    def _kind_of_name(self, name: str) -> _Kind | None:
        given = self.given.get(name, [])
        if not given or len(given) != self.bound.get(name, 0) or name in self.asked:
            return None
        self.asked.add(name)
        try:
            kinds = {self._kind(what) if isinstance(what, ast.expr) else what for what in given}
        finally:
            self.asked.discard(name)
        return kinds.pop() if len(kinds) == 1 else None

    def _called(self, node: ast.expr) -> object:
        """The called object if it belongs to the package; `Functions` for an expression function, the provider for one of its actions."""
        if isinstance(node, ast.Name):
            return None if node.id in self.bound else self.names.get(node.id)
        if not isinstance(node, ast.Attribute):
            return None
        of = self._called(node.value)
        if isinstance(of, Functions):
            return Functions
        if isinstance(of, types.ModuleType):
            return getattr(of, node.attr, None)
        return of if isinstance(of, _states.Provider) else None


def _condition(value: ast.expr, other: bool | None, is_same: bool) -> str:
    text = ast.unparse(value)
    if other is None:
        return f"{text} == None" if is_same else f"{text} != None"
    return text if other is is_same else f"~({text})"


def _bound_by(part: ast.AST) -> list[str]:
    """The names that a statement binds."""
    if isinstance(part, ast.Name):
        return [] if isinstance(part.ctx, ast.Load) else [part.id]
    if isinstance(part, ast.arg):
        return [part.arg]
    if isinstance(part, ast.alias):
        return [(part.asname or part.name).split(".")[0]]
    if isinstance(part, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.ExceptHandler, ast.MatchAs, ast.MatchStar)):
        return [part.name] if part.name else []
    if isinstance(part, (ast.Global, ast.Nonlocal)):
        return part.names
    return []
