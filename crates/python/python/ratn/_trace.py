"""What is being traced: the states in the making, and the outputs of those that there are."""

from __future__ import annotations

import ast
import contextvars
import typing
from collections.abc import Sequence
from typing import Any, NoReturn

from ratn._expression import Value, refuse, statements_at_work, user_line, written
from ratn._yaml import Body

if typing.TYPE_CHECKING:
    from ratn._states import TaskFunction

tracing: contextvars.ContextVar[Trace | None] = contextvars.ContextVar("ratn_tracing", default=None)


class Node:
    """A state in the making: its body, and the lists of states inside."""

    def __init__(self, siblings: list[Node], owner: Node | None, name: str | None, line: tuple[str, int], default: str) -> None:
        self.siblings, self.owner, self.default, self.line = siblings, owner, default, line
        self.body = Body()
        self.body.line = line
        self.branches: dict[str, list[Node]] = {}
        self.before: list[Node] | None = None
        self.is_open = False
        self.name = None if name is None else self._unique(name)
        siblings.append(self)

    def _unique(self, name: str) -> str:
        taken = {other.name for other in self.siblings}
        number = 2
        unique = name
        while unique in taken:
            unique, number = f"{name}_{number}", number + 1
        return unique

    def named(self) -> str:
        """Its name; one that had none gets one, because somebody speaks of it."""
        if self.name is None:
            self.name = self._unique(self.default)
        return self.name

    def put_out(self, text: str, *names: str) -> str:
        """The name of the output with this value, which is added where there is none."""
        outputs = self.body.setdefault("outputs", {})
        known = [name for name, said in outputs.items() if said == text]
        free = [name for name in names if name not in outputs] or [f"{names[-1]}_{len(outputs)}"]
        name = known[0] if known else free[0]
        outputs[name] = text
        return str(name)

    def item(self) -> Body:
        """As it stands in a list of states."""
        body = Body(self.body)
        body.line = self.line
        for key, inside in self.branches.items():
            body[key] = [node.item() for node in inside]
        if self.before is not None:
            body["retry"] = {**body.get("retry", {}), "before": [node.item() for node in self.before]}
        if self.name is None:
            return body
        item = Body({self.name: body})
        item.line = self.line
        return item


class Trace:
    """What is being traced: the lists of states that are open, the innermost last."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.top: list[Node] = []
        self.open: list[tuple[list[Node], Node | None]] = [(self.top, None)]
        self.variables: dict[str, Any] = {}
        self.catalogues: list[str] = []
        self.steps: dict[str, Any] = {}
        self.functions: dict[str, tuple[TaskFunction, str, str]] = {}

    @staticmethod
    def now(what: str) -> Trace:
        """The one that is at work."""
        trace = tracing.get()
        if trace is None:
            refuse(f"{what} belongs into a task", "call it in a function with `@ratn.task`")
        return trace

    def add(self, name: str | None, default: str, at: tuple[str, int] | None = None) -> Node:
        siblings, owner = self.open[-1]
        return Node(siblings, owner, name, at or user_line(), default)

    def enter(self, node: Node, branch: str) -> None:
        node.is_open = True
        self.open.append((node.branches.setdefault(branch, []), node))

    def leave(self, node: Node) -> None:
        innermost = self.open[-1][1]
        if innermost is not node:
            self.unfinished(innermost)
        self.open.pop()
        node.is_open = False

    def unfinished(self, node: Node | None) -> NoReturn:
        at = node.line if node is not None else None
        refuse("the block that begins here is left in its middle", "a `break` or `return` cannot be traced: write `with ratn.when(…)`, or a transition", at)

    def seen(self, node: Node, port: str) -> str:
        """What an output of a state is called here."""
        lists = [siblings for siblings, _ in self.open]
        if any(siblings is node.siblings for siblings in lists):
            return f"{node.named()}.{port}"
        owner = node.owner
        if owner is None:
            refuse(f"`{node.named()}` is a state of another task", "states see those of their own task only")
        if node.siblings is owner.before or node.siblings is owner.branches.get("finally"):
            where = f"{owner.line[0]}:{owner.line[1]}"
            refuse(
                f"`{node.named()}` is not seen outside of the block that begins at {where}",
                "a `before` or a `lastly` has no outputs: let an effect say it as a fact, and read that",
            )
        if port == "outcome":
            refuse(f"how `{node.named()}` ended is seen only beside it", "let an effect say it as a fact, or give the block around an outcome")
        return self.seen(owner, owner.put_out(f"{node.named()}.{port}", port, f"{node.named()}_{port}"))

    def first_of(self, ways: Sequence[object]) -> str:
        """`either` of some values. Where some are inside of one block, that puts out the first of all of them, but for those that only come
        behind the block: they stay beside it."""
        around = [self._hides(way) for way in ways]
        hidden = {id(block): block for block in around if block is not None}
        if len(hidden) != 1:
            return f"either({', '.join(str(written(way)) for way in ways)})"
        (block,) = hidden.values()
        behind = [at for at, way in enumerate(ways) if around[at] is None and self._is_behind(way, block)]
        first = behind[-1] + 1 if behind else 0
        if any(around[:first]):
            refuse(
                f"`fn.either` has a value from inside of `{block.named()}` before one from a state behind it",
                "name the values from behind the block first, or use `fn.either` twice",
            )
        beside, within = ways[:first], ways[first:]
        depth = len(self.open)
        self.open += [(states, block) for states in block.branches.values()]
        try:
            text = self.first_of(within) if len(within) > 1 else str(written(within[0]))
        finally:
            del self.open[depth:]
        (port, *_) = _ports(next(way for way, hides in zip(ways, around, strict=True) if hides is not None))
        seen = f"{block.named()}.{block.put_out(text, port.port, f'either_{port.port}')}"
        # The block may have failed, and that been handled: then the others are looked through beside it.
        others = [way for at, way in enumerate(ways) if at >= first and around[at] is None]
        all_ways = [*(str(written(way)) for way in beside), seen, *(str(written(way)) for way in others)]
        return f"either({', '.join(all_ways)})" if len(all_ways) > 1 else seen

    def _is_behind(self, way: object, block: Node) -> bool:
        """Whether a value is of a state beside a block that comes only after it."""
        beside = [port.node for port in _ports(way) if port.node.siblings is block.siblings]
        return any(block.siblings.index(node) > block.siblings.index(block) for node in beside)

    def _hides(self, way: object) -> Node | None:
        """The block beside what is open that a value is inside of, if it is."""
        for port in _ports(way):
            node = port.node
            while not any(siblings is node.siblings for siblings, _ in self.open) and node.owner is not None:
                node = node.owner
            if node is not port.node:
                return node
        return None

    def collects(self) -> int:
        """Where among what is open the innermost loop is."""
        for at, (states, owner) in reversed(list(enumerate(self.open))):
            if owner is not None and states is owner.branches.get("do"):
                return at
        refuse("`ratn.collect` outside of a loop", "write it inside of `for x in ratn.each(list):`, or of another loop")


class Port:
    """An output of a state, named as it is seen where it is written down."""

    def __init__(self, node: Node, port: str) -> None:
        self.node, self.port = node, port

    def __str__(self) -> str:
        return Trace.now(f"`{self.node.named()}.{self.port}`").seen(self.node, self.port)


class Either:
    """The first of some values that was written on the way that was taken."""

    def __init__(self, ways: Sequence[object]) -> None:
        self.ways = ways

    def __str__(self) -> str:
        return Trace.now("`fn.either`").first_of(self.ways)


def _ports(value: object) -> list[Port]:
    """The outputs that a value is made of."""
    if isinstance(value, Port):
        return [value]
    if isinstance(value, Either):
        return [port for way in value.ways for port in _ports(way)]
    if isinstance(value, dict):
        return _ports(list(value.values()))
    parts = value._parts if isinstance(value, Value) else value if isinstance(value, (list, tuple)) else ()
    return [port for part in parts for port in _ports(part)]


class State:
    """A state of a task. Its outputs are its attributes, ``look.boxes``; in ``transitions`` it stands for itself."""

    __slots__ = ("_node",)
    #: How it ended, as the ``decide`` of a concurrency sees it of its regions.
    outcome: Value

    def __init__(self, node: Node) -> None:
        self._node = node

    if not typing.TYPE_CHECKING:
        # To type checkers a state has the outputs that stubs say.
        def __getattr__(self, name):
            if name.startswith("_"):
                raise AttributeError(name)
            return Value(Port(self._node, name))

    def __getitem__(self, name: str) -> Value:
        return Value(Port(self._node, name))

    def __repr__(self) -> str:
        return f"<State {self._node.named()}>"

    def __bool__(self) -> bool:
        refuse("whether a state succeeds is known only while the task runs", "say `transitions={\"aborted\": …}` at it, or `ratn.retry(n)` around it")


class AnyState(State):
    """A state of which type checkers do not know the outputs."""

    __slots__ = ()
    if typing.TYPE_CHECKING:

        def __getattr__(self, name: str) -> Value: ...


def assigned_name(function: str, at: tuple[str, int]) -> str | None:
    """The variable that the call at a line is assigned to, ``look = detector.segment(…)``: its state is called so, too."""
    for node in statements_at_work(*at):
        if isinstance(node, ast.NamedExpr) and calls(node.value, function):
            return node.target.id
        if isinstance(node, ast.Assign) and len(node.targets) == 1 and calls(node.value, function):
            target = node.targets[0]
            return target.id if isinstance(target, ast.Name) else None
        if isinstance(node, ast.With):
            for item in node.items:
                if calls(item.context_expr, function) and isinstance(item.optional_vars, ast.Name):
                    return item.optional_vars.id
    return None


def calls(node: ast.expr, function: str) -> bool:
    if not isinstance(node, ast.Call):
        return False
    name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id if isinstance(node.func, ast.Name) else ""
    return name == function
