"""Expressions of a task as Python objects: values that are known only while the task runs.

A ``Value`` is written down, never computed: ``look.boxes[0].size.x + 0.1`` is the text of an expression of task files, with the states in it
named as they are seen from the place where the text is used. Whatever Python would have to know now (a truth, a length, the elements) is
refused with the line of the user's file and with what to write instead.
"""

from __future__ import annotations

import ast
import contextlib
import contextvars
import linecache
import math
import os
import re
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NoReturn

from ratn import _ratn
from ratn._ratn import Aborted, Cancelled, Error, Joints, Lost, Pose

_PACKAGE = os.path.dirname(os.path.abspath(__file__)) + os.sep
_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
KEYWORDS = {"or", "and", "not", "in", "exists", "true", "false", "null"}
#: An invisible character around the number of a value in an f-string. The value is written when the text is used, in the form for that place; it is refused
#: in a text that is no expression. If there is nothing between two of them, the text after them is that of a value that is the same everywhere.
_MARK = "\u2063"
_MARKED = re.compile(f"{_MARK}(?:<value_([0-9]+)>)?{_MARK}")


class Untraceable(Error):
    """Python code that cannot be traced as a task: it needs a value that is known only while the task runs. Names the line, and what to write instead."""


def user_frame() -> types.FrameType:
    """The frame of the user's code that is running."""
    frame: types.FrameType | None = sys._getframe(1)
    while frame is not None and os.path.abspath(frame.f_code.co_filename).startswith(_PACKAGE):
        frame = frame.f_back
    if frame is None:
        raise AssertionError("somebody called this")
    return frame


def user_line() -> tuple[str, int]:
    frame = user_frame()
    return frame.f_code.co_filename, frame.f_lineno


_TREES: dict[str, tuple[int, ast.Module | None]] = {}


def _tree(file: str) -> ast.Module | None:
    """The parsed source of a file, if there is one; also of a notebook cell."""
    linecache.checkcache(file)
    lines = linecache.getlines(file)
    text = "".join(lines)
    known = _TREES.get(file)
    if known is None or known[0] != hash(text):
        try:
            known = (hash(text), ast.parse(text) if lines else None)
        except SyntaxError:
            known = (hash(text), None)
        _TREES[file] = known
    return known[1]


def statements_at_work(file: str, line: int) -> list[ast.AST]:
    """The statements at a line, the innermost first."""
    tree = _tree(file)
    if tree is None:
        return []
    found: list[ast.AST] = [
        node for node in ast.walk(tree)
        if isinstance(node, (ast.stmt, ast.expr, ast.comprehension)) and _begins(node) <= line <= _ends(node)
    ]
    found.sort(key=lambda node: _ends(node) - _begins(node))
    return found


def function_at(file: str, line: int, name: str) -> ast.FunctionDef | None:
    """The function of this name that begins at a line, with its decorators."""
    tree = _tree(file)
    for node in () if tree is None else ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name == name and min(map(_begins, [node, *node.decorator_list])) == line:
            return node
    return None


def jump_out_of_with(file: str, line: int) -> tuple[str, int] | None:
    """The first ``return``, ``break`` or ``continue`` that leaves the body of the ``with`` statement that begins at a line, and its line."""
    for node in statements_at_work(file, line):
        if isinstance(node, (ast.With, ast.AsyncWith)) and any(_begins(item.context_expr) <= line <= _ends(item.context_expr) for item in node.items):
            return _jump(node.body, False)
    return None


def _jump(body: Sequence[ast.AST], is_in_loop: bool) -> tuple[str, int] | None:
    for node in body:
        if isinstance(node, ast.Return):
            return "return", node.lineno
        if isinstance(node, (ast.Break, ast.Continue)) and not is_in_loop:
            return type(node).__name__.lower(), node.lineno
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.expr)):
            continue
        is_loop = isinstance(node, (ast.For, ast.AsyncFor, ast.While))
        for name, part in ast.iter_fields(node):
            if isinstance(part, list) and part and isinstance(part[0], ast.AST):
                # A jump in the `else` of a loop leaves the block as well.
                found = _jump(part, (is_loop and name == "body") or is_in_loop)
                if found is not None:
                    return found
    return None


def handler_of(file: str, line: int, names: Mapping[str, object]) -> tuple[str, int] | None:
    """The first exception that ends an action (``ratn.Aborted``) and is caught by an ``except`` around a line, and its line. ``names`` are those known there."""
    for node in statements_at_work(file, line):
        if isinstance(node, ast.Try) and any(_begins(one) <= line <= _ends(one) for one in node.body):
            for handler in node.handlers:
                for one in handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]:
                    text = "" if one is None else ast.unparse(one)
                    kind = _named(text, names)
                    if kind in (Aborted, Cancelled, Lost):
                        return text, handler.lineno
    return None


def _named(text: str, names: Mapping[str, object]) -> object:
    """The object that a dotted name refers to."""
    first, *rest = text.split(".")
    found = names.get(first)
    for name in rest:
        found = getattr(found, name, None)
    return found


def _begins(node: ast.AST) -> int:
    own = node.iter if isinstance(node, ast.comprehension) else node
    return int(getattr(own, "lineno", 0))


def _ends(node: ast.AST) -> int:
    own = node.ifs[-1] if isinstance(node, ast.comprehension) and node.ifs else node.iter if isinstance(node, ast.comprehension) else node
    return int(getattr(own, "end_lineno", 0) or 0)


def refuse(what: str, instead: str, at: tuple[str, int] | None = None) -> NoReturn:
    """Raises ``Untraceable`` for the user's line."""
    file, line = at or user_line()
    raise Untraceable(f"{file}:{line}: {what}: {instead}")


def _truth_wanted() -> NoReturn:
    """Refuses a truth test of a value; the message depends on what makes the test."""
    file, line = user_line()
    what, instead = "Python asks whether this is true, which is known only while the task runs", "write `with ratn.when(condition):`"
    for node in statements_at_work(file, line):
        if isinstance(node, ast.BoolOp):
            word, sign = ("and", "&") if isinstance(node.op, ast.And) else ("or", "|")
            what, instead = f"`{word}` needs to know now which side is true", f"write `(a) {sign} (b)`, with parentheses around both"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            what, instead = "`not` needs to know the value now", "write `~(a)`"
        elif isinstance(node, ast.Compare) and len(node.ops) > 1:
            what, instead = "`a < b < c` needs to know the first half now", "write `(a < b) & (b < c)`"
        elif isinstance(node, ast.Compare) and isinstance(node.ops[0], (ast.In, ast.NotIn)):
            what, instead = "`in` needs to know the elements now", "write `ratn.isin(a, b)`"
        elif isinstance(node, ast.IfExp):
            what, instead = "`a if condition else b` needs to know the condition now", "write `fn.if_(condition, a, b)`"
        elif isinstance(node, (ast.If, ast.While)) and not node.test.lineno <= line <= (node.test.end_lineno or 0):
            continue
        elif isinstance(node, ast.If):
            what = "a Python `if` on a value that is known only while the task runs"
            instead = "write `with ratn.when(condition):`, and `with ratn.otherwise():` for the `else`"
        elif isinstance(node, ast.While):
            what, instead = "a Python `while` on a value that is known only while the task runs", "write `with ratn.while_(condition):`"
        elif isinstance(node, ast.Assert):
            what = "`assert` of a value that is known only while the task runs"
            instead = "say `requires=[…]` at the state that needs it, or write `with ratn.when(condition):`"
        elif isinstance(node, ast.comprehension):
            what, instead = "the `if` of a comprehension needs to know the elements now", "write `fn.filter(list, lambda x: condition)`"
        else:
            continue
        break
    refuse(what, instead, (file, line))


def plain(part: object) -> str:
    """A part of an expression, written for the place that is being traced."""
    text: str = part if isinstance(part, str) else part._text()  # type: ignore[attr-defined]
    return text


def expression(value: object) -> str:
    """Writes a Python value as the text of an expression."""
    return plain(written(value))


def parts_of(text: str) -> list[object]:
    """Splits a text in the language of task files into texts and the values that f-strings in it name."""
    parts: list[object] = []
    for index, part in enumerate(_MARKED.split(str.__str__(text))):
        if not part:
            continue
        if index % 2 == 1:
            from ratn._trace import Trace

            parts.append(Trace.now("a text with a value of a task in it").named_in_text(int(part)))
        elif _MARK in part:
            refuse("a text of which an f-string with a value was taken apart", "write an f-string of the whole text")
        else:
            parts.append(part)
    return parts


def words(text: str) -> str:
    """A text in the language of task files, written for the place that is being traced: an f-string in it may name values."""
    return "".join(map(plain, parts_of(text)))


def _shown(text: str) -> str:
    """A text in the form for people."""
    try:
        return words(text)
    except Untraceable:
        return _MARKED.sub("…", text).replace(_MARK, "")


def literal(text: str, what: str = "a text") -> str:
    """A literal text, which is no expression."""
    if _MARK in text:
        refuse(
            f"{what} with a value in it that is known only while the task runs, `{_shown(text)}`",
            'write `fn.concat("…", value)`; an f-string names values only in annotations, conditions and `ratn.expr`',
        )
    # `str()` of an enumeration member differs from its value.
    return str.__str__(text)


def _quoted(text: str) -> str:
    """A text quoted for an expression, which has fewer escapes than JSON: all other characters are written as they are."""
    for sign, escaped in (("\\", "\\\\"), ('"', '\\"'), ("\n", "\\n"), ("\t", "\\t")):
        text = text.replace(sign, escaped)
    return f'"{text}"'


def _field(name: str) -> str:
    return name if _WORD.match(name) else _quoted(name)


def key_of(name: object, what: str = "a name") -> str:
    """A key of a map."""
    if isinstance(name, int) and not isinstance(name, bool):
        return int.__repr__(name)
    return literal(name if isinstance(name, str) else str(name), what)


class Value:
    """An expression: a value that is known only while the task runs. ``+ - * /``, comparisons, ``& | ~``, ``.field`` and ``[i]`` make further expressions.

    In an f-string of an annotation it becomes its text, as it is visible at the annotation's place: ``effects=[f"at({box.id}) = {box.pose}"]``.
    Elsewhere strings are literal, and such an f-string is refused: ``fn.concat("Box ", box.id)`` makes a text of values.
    """

    __slots__ = ("_parts", "_is_atom")
    _parts: tuple[object, ...]
    _is_atom: bool

    def __init__(self, *parts: object, is_atom: bool = True) -> None:
        object.__setattr__(self, "_parts", parts)
        object.__setattr__(self, "_is_atom", is_atom)

    def _text(self) -> str:
        return "".join(map(plain, self._parts))

    def __str__(self) -> str:
        from ratn._trace import tracing

        trace = tracing.get()
        return f"{_MARK}{_MARK}{self._text()}" if trace is None else f"{_MARK}<value_{trace.name_in_text(self)}>{_MARK}"

    def __format__(self, form: str) -> str:
        if form:
            refuse(f"the format `{form}` needs to know the value now", "leave the format away: `{value}`")
        return str(self)

    def __repr__(self) -> str:
        try:
            return f"<Value {self._text()}>"
        except Untraceable:
            return "<Value of a task that is not being traced>"

    def __setattr__(self, name: str, value: object) -> None:
        refuse(f"`{name}` of a value that is known only while the task runs cannot be set", "let an effect change the world, or `assign` a variable")

    def __getattr__(self, name: str) -> Value:
        if name.startswith("_"):
            raise AttributeError(name)
        return Value(within(self), f".{name}")

    def __getitem__(self, index: object) -> Value:
        if isinstance(index, slice):
            if index.start in (None, 0) and index.step in (None, 1) and index.stop is not None:
                return call("take", self, index.stop)
            refuse("a slice", "write `fn.take(list, n)` for the first n")
        if isinstance(index, str):
            return Value(within(self), f".{index}")
        return Value(within(self), "[", written(index), "]")

    def _binary(self, sign: str, other: object, is_turned: bool = False) -> Value:
        left, right = (other, self) if is_turned else (self, other)
        return Value(within(left), f" {sign} ", within(right), is_atom=False)

    def __add__(self, other: object) -> Value:
        return self._binary("+", other)

    def __radd__(self, other: object) -> Value:
        return self._binary("+", other, True)

    def __sub__(self, other: object) -> Value:
        return self._binary("-", other)

    def __rsub__(self, other: object) -> Value:
        return self._binary("-", other, True)

    def __mul__(self, other: object) -> Value:
        return self._binary("*", other)

    def __rmul__(self, other: object) -> Value:
        return self._binary("*", other, True)

    def __truediv__(self, other: object) -> Value:
        return self._binary("/", other)

    def __rtruediv__(self, other: object) -> Value:
        return self._binary("/", other, True)

    def __neg__(self) -> Value:
        return Value("-", within(self), is_atom=False)

    def __abs__(self) -> Value:
        return call("abs", self)

    def __matmul__(self, other: object) -> Value:
        return call("compose", self, other)

    def __rmatmul__(self, other: object) -> Value:
        return call("compose", other, self)

    def __eq__(self, other: object) -> Value:  # type: ignore[override]
        return self._binary("=", other)

    def __ne__(self, other: object) -> Value:  # type: ignore[override]
        return self._binary("!=", other)

    def __lt__(self, other: object) -> Value:
        return self._binary("<", other)

    def __le__(self, other: object) -> Value:
        return self._binary("<=", other)

    def __gt__(self, other: object) -> Value:
        return self._binary(">", other)

    def __ge__(self, other: object) -> Value:
        return self._binary(">=", other)

    def __and__(self, other: object) -> Value:
        return self._binary("and", other)

    def __rand__(self, other: object) -> Value:
        return self._binary("and", other, True)

    def __or__(self, other: object) -> Value:
        return self._binary("or", other)

    def __ror__(self, other: object) -> Value:
        return self._binary("or", other, True)

    def __invert__(self) -> Value:
        return Value("not ", within(self), is_atom=False)

    def __bool__(self) -> bool:
        _truth_wanted()

    def __hash__(self) -> int:
        refuse("a key of a dict or an element of a set has to be known now", "use a list, or an expression with `fn`")

    def __len__(self) -> int:
        refuse("`len` needs to know the list now", "write `fn.len(list)`")

    def __contains__(self, item: object) -> bool:
        refuse("`in` needs to know the elements now", "write `ratn.isin(item, list)`")

    def __iter__(self) -> Iterator[Value]:
        file, line = user_line()
        for node in statements_at_work(file, line):
            if isinstance(node, ast.comprehension):
                refuse("a comprehension needs to know the elements now", "write `fn.map(list, lambda x: value)` or `fn.filter(…)`")
            if isinstance(node, ast.For):
                break
        refuse("a loop over a list that is known only while the task runs", "write `for x in ratn.each(list):`")

    def __int__(self) -> int:
        refuse("`int` needs to know the value now", "use the value as it is; `fn.floor(x)` rounds it down")

    def __float__(self) -> float:
        file, line = user_line()
        for node in statements_at_work(file, line):
            called = node.func if isinstance(node, ast.Call) else None
            name = called.attr if isinstance(called, ast.Attribute) else called.id if isinstance(called, ast.Name) else ""
            if name in ("Pose", "Joints"):
                refuse(f"`{name}` needs to know the numbers now", f"write `fn.{name.lower()}(…)`", (file, line))
        refuse("`float` needs to know the value now", "use the value as it is")

    def __index__(self) -> int:
        file, line = user_line()
        for node in statements_at_work(file, line):
            if isinstance(node, ast.For):
                refuse("`range` needs to know the number now", "write `for i in ratn.each(fn.range(n)):`", (file, line))
        refuse("the number is known only while the task runs", "write `fn.range(n)` for a range, `list[i]` of a value of the task")


class Binding:
    """A variable of a task file, with the state that binds it. At a place where another variable of the same name hides it, its use is refused."""

    def __init__(self, name: str, kind: str, line: tuple[str, int]) -> None:
        self.name, self.kind, self.line = name, kind, line

    def __str__(self) -> str:
        return f"the {self.kind} `${self.name}` of {self.line[0]}:{self.line[1]}"

    def _text(self) -> str:
        for inner in reversed(_bound.get()):
            if inner is self:
                return f"${self.name}"
            if isinstance(inner, TaskFunctionScope):
                refuse(f"`{inner.name}` sees its parameters and facts only, and uses {self}", "give it that as another parameter")
            if inner.name == self.name:
                self.hidden_by(str(inner))
        if self.kind == "element":
            refuse(f"{self} is known only inside of its `lambda`", "use it there")
        from ratn._trace import Trace

        Trace.now(f"`${self.name}`").sees(self)
        return f"${self.name}"

    def hidden_by(self, other: str) -> NoReturn:
        how = "`variable=`" if self.kind == "element of the loop" else "`index=`" if self.kind == "number of the iteration" else "another name"
        refuse(f"{self} is hidden here by {other}", f"give one of the two another name ({how})" if how.startswith("`") else "give one of the two another name")


class TaskFunctionScope:
    """The scope of a function of the task: it sees nothing of the surrounding scopes."""

    def __init__(self, name: str) -> None:
        self.name = name


#: The bindings of element functions and task functions that are being written, the innermost last.
_bound: contextvars.ContextVar[tuple[Binding | TaskFunctionScope, ...]] = contextvars.ContextVar("ratn_bound", default=())


@contextlib.contextmanager
def binding(*inner: Binding | TaskFunctionScope) -> Iterator[None]:
    token = _bound.set((*_bound.get(), *inner))
    try:
        yield
    finally:
        _bound.reset(token)


def scope_of_function() -> str | None:
    """The scope of the task function whose body is being written."""
    return next((inner.name for inner in reversed(_bound.get()) if isinstance(inner, TaskFunctionScope)), None)


class Within:
    """An expression that uses an element, at places where the element is bound."""

    def __init__(self, element: Binding, value: object) -> None:
        self.element, self.value = element, value

    def _text(self) -> str:
        with binding(self.element):
            return plain(self.value)


class Variable(Value):
    """A parameter, a scoped variable, or a loop's variable: ``$name``."""

    __slots__ = ()

    def _in_place(self, sign: str, other: object) -> NoReturn:
        (bound,) = self._parts
        assert isinstance(bound, Binding)
        name = bound.name
        what = f"`{name} {sign}= …` would leave the {bound.kind} as it is, and make another value"
        more = f"give that a name of its own, `more = {name} {sign} …`"
        if bound.kind == "variable":
            refuse(what, f"say `assign={{\"{name}\": {name} {sign} …}}` at a state that changes it, or {more}")
        refuse(what, f"{more}, or count in a `ratn.variable(0)` that states `assign`")

    def __iadd__(self, other: object) -> NoReturn:
        self._in_place("+", other)

    def __isub__(self, other: object) -> NoReturn:
        self._in_place("-", other)

    def __imul__(self, other: object) -> NoReturn:
        self._in_place("*", other)

    def __itruediv__(self, other: object) -> NoReturn:
        self._in_place("/", other)

    def __imatmul__(self, other: object) -> NoReturn:
        self._in_place("@", other)

    def __iand__(self, other: object) -> NoReturn:
        self._in_place("&", other)

    def __ior__(self, other: object) -> NoReturn:
        self._in_place("|", other)


def within(part: object) -> object:
    """Writes an operand, in parentheses if needed."""
    if isinstance(part, Value) and part._is_atom:
        return part
    if isinstance(part, Value):
        return Value("(", part, ")")
    text = written(part)
    return Value("(", text, ")") if isinstance(text, str) and text.startswith("-") else text


def written(value: object) -> object:
    """Writes a Python value as a part of an expression."""
    if isinstance(value, Value):
        return value
    if getattr(type(value), "_is_state", False):
        refuse("a state is no value", "name one of its outputs, `look.boxes`")
    if isinstance(value, str):
        value = literal(value)
        return value if _WORD.match(value) and value not in KEYWORDS else _quoted(value)
    if isinstance(value, range) and value.step == 1:
        return f"range({value.start}, {value.stop})" if value.start else f"range({value.stop})"
    if isinstance(value, (list, tuple)):
        return Value("[", *_joined(written(item) for item in value), "]")
    if isinstance(value, dict):
        pairs = (Value(f"{_field(key_of(name))}: ", written(item)) for name, item in value.items())
        return Value("{", *_joined(pairs), "}")
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Pose):
        turned = _roll_pitch_yaw(value)
        return f"pose({', '.join(_number(number) for number in (*value.position, *(turned if any(turned) else ())))})"
    if isinstance(value, Joints):
        return f"joints({', '.join(_number(number) for number in value)})"
    if isinstance(value, (int, float)) and not hasattr(value, "tolist"):
        if isinstance(value, int):
            return _whole_number(value)
        if not math.isfinite(value):
            refuse(f"{value} is no number of a task", "use finite numbers")
        return float.__repr__(value)
    if hasattr(value, "tolist"):
        return written(value.tolist())
    refuse(f"a {type(value).__name__} is no value of a task", "use numbers, texts, lists, dicts, ratn.Pose, ratn.Joints, or values of the task")


def _whole_number(number: int) -> str:
    if not -(2**63) <= number < 2**63:
        refuse(f"{number} is no number of a task", "use whole numbers of at most 64 bits, or floats")
    # The number without its sign would be too large.
    return int.__repr__(number) if number > -(2**63) else f"({number + 1} - 1)"


def _number(number: float) -> str:
    return str(int(number)) if number == int(number) and abs(number) < 1e15 else repr(number)


def _roll_pitch_yaw(pose: Pose) -> tuple[float, float, float]:
    """The rotation about the fixed axes x, y, z, radians."""
    x, y, z, w = pose.quaternion
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    if abs(pitch) > math.pi / 2 - 1e-6:
        # At this pitch only the difference of roll and yaw matters.
        roll, yaw = 0.0, -2 * math.copysign(1, pitch) * math.atan2(x, w)
    return (round(roll, 15), round(pitch, 15), round(yaw, 15))


def _joined(parts: Iterable[object]) -> list[object]:
    joined: list[object] = []
    for part in parts:
        joined += [", ", part] if joined else [part]
    return joined


def call(function: str, *arguments: object) -> Value:
    """A call of an expression function."""
    return Value(f"{function}(", *_joined(written(argument) for argument in arguments), ")")


def expr(text: str) -> Value:
    """An expression in the syntax of task files: ``ratn.expr("grasp_pose($box)")``. An f-string may contain values: ``ratn.expr(f"{box}.id")``."""
    parts = parts_of(text)
    (single,) = parts if len(parts) == 1 else (None,)
    is_atom = single._is_atom if isinstance(single, Value) else isinstance(single, str) and bool(_WORD.match(single.lstrip("$")))
    return Value(*parts, is_atom=is_atom)


def fact(predicate: str, *arguments: object) -> Value:
    """The value of a fact in the world at the state's place: ``ratn.fact("at", "cup")`` is the pose; ``"?"`` matches any argument."""
    said = ("?" if isinstance(argument, str) and argument == "?" else written(argument) for argument in arguments)
    return Value(*parts_of(predicate), "(", *_joined(said), ")")


def exists(what: Value | str) -> Value:
    """Whether a fact exists, whatever its value, ``ratn.exists(ratn.fact("in_gripper", "cup"))``; or a query with variables, as a string."""
    said = (what,) if isinstance(what, Value) else ("(", *parts_of(what), ")")
    return Value("exists ", *said, is_atom=False)


def isin(item: object, of: object) -> Value:
    """``item in of``: whether a list has the element, or a map the key."""
    return Value(within(item), " in ", within(of), is_atom=False)


_OF_ELEMENTS = {"map", "filter", "sort_by", "min_by", "max_by", "any", "all"}


class Functions:
    """The functions of expressions: ``fn.len(look.boxes)``, ``fn.compose(a, b)``, ``fn.filter(boxes, lambda b: b.size[0] > 0.1)``."""

    def __getattr__(self, name: str) -> Callable[..., Value]:
        if name.startswith("_"):
            raise AttributeError(name)
        known = name.rstrip("_")
        if known not in _functions():
            near = ", ".join(sorted(_functions() | _OF_ELEMENTS))
            raise AttributeError(f"there is no function `{name}` in expressions; there are {near}")
        return lambda *arguments: _applied(known, arguments)

    def __dir__(self) -> list[str]:
        return sorted(name if name != "if" else "if_" for name in _functions())


def _applied(name: str, arguments: tuple[object, ...]) -> Value:
    if name == "either":
        from ratn._trace import Either

        # Its text depends on where the states are that give the values; this is known when the expression is written.
        return Value(Either(arguments))
    if name not in _OF_ELEMENTS:
        return call(name, *arguments)
    if len(arguments) != 2 or not callable(arguments[1]):
        raise TypeError(f"`fn.{name}` takes a list and a function of an element: `fn.{name}(list, lambda x: …)`")
    function: Any = arguments[1]
    code = function.__code__
    element = Binding(code.co_varnames[0], "element", (code.co_filename, code.co_firstlineno))
    return Value(f"{name}(${element.name} in ", written(arguments[0]), ", ", Within(element, written(function(Variable(element)))), ")")


def _functions() -> set[str]:
    return set(_ratn.functions()) | _OF_ELEMENTS


fn = Functions()
