"""The state of tracing: the states in construction, and the outputs of those that exist."""

from __future__ import annotations

import ast
import contextvars
import itertools
import typing
from collections.abc import Sequence
from typing import Any, NoReturn

from ratn._expression import KEYWORDS, Binding, Value, Within, expression, handler_of, jump_out_of_with, literal, refuse, scope_of_function, statements_at_work, user_frame, user_line
from ratn._source import WORDS_OF_FORMS
from ratn._yaml import Body

if typing.TYPE_CHECKING:
    from ratn._states import TaskFunction

tracing: contextvars.ContextVar[Trace | None] = contextvars.ContextVar("ratn_tracing", default=None)
#: Names that no state may have, because they have another meaning in a task file.
_NO_NAMES = WORDS_OF_FORMS | KEYWORDS
#: The numbers of values in texts. They are unique across tasks.
_numbers = itertools.count()


class Node:
    """A state in construction: its body, and its inner lists of states."""

    def __init__(
        self, siblings: list[Node], owner: Node | None, name: str | None, line: tuple[str, int], default: str, implied: str | None = None
    ) -> None:
        self.siblings, self.owner, self.default, self.line = siblings, owner, default, line
        self.body = Body()
        self.body.line = line
        self.name: str | None = None
        self.branches: dict[str, list[Node]] = {}
        self.before: list[Node] | None = None
        self.is_open = False
        #: The variables that it binds, for the states inside it.
        self.bindings: dict[str, Binding] = {}
        #: Variables from outside that were named inside it.
        self.spoken: dict[str, Binding] = {}
        siblings.append(self)
        beside = self._beside()
        if name is not None:
            self.name = _free(name, beside)
        else:
            # A default name hides no name from outside.
            self.name = None if implied is None else _free(implied, beside | self._around() | _NO_NAMES)

    def _beside(self) -> set[str | None]:
        """The names of the other states in its list; also those that states without a name get when the file is read, one after the other."""
        names = set[str | None]()
        is_before = True
        for other in self.siblings:
            if other is self:
                is_before = False
            elif other.name is not None:
                names.add(other.name)
            elif is_before:
                names.add(_free(other.default, names))
        return names

    def _around(self) -> set[str | None]:
        """The names of the siblings of the states that contain it."""
        names, node = set[str | None](), self.owner
        while node is not None:
            names |= {other.name for other in node.siblings}
            node = node.owner
        return names

    def _below(self) -> set[str | None]:
        """The names of all states inside it."""
        lists = [*self.branches.values(), *([self.before] if self.before else [])]
        return {name for states in lists for node in states for name in (node.name, *node._below())}

    def named(self) -> str:
        """Its name; a state without one gets one, because it is referred to."""
        if self.name is None:
            below = {name for other in self.siblings for name in other._below()}
            self.name = _free(self.default, below | self._beside() | self._around() | _NO_NAMES)
        return self.name

    def put_out(self, text: str, *names: str) -> str:
        """The name of the output with this value; adds the output if there is none."""
        outputs = self.body.setdefault("outputs", {})
        known = [name for name, said in outputs.items() if said == text]
        free = [name for name in names if name not in outputs] or [f"{names[-1]}_{len(outputs)}"]
        name = known[0] if known else free[0]
        outputs[name] = text
        return str(name)

    def item(self) -> Body:
        """Its entry in a list of states."""
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


def _free(name: str, taken: typing.Collection[str | None]) -> str:
    """The name, with a number appended if it is taken."""
    number, free = 2, name
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free


class Trace:
    """The state of a trace: the open lists of states, the innermost last."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.top: list[Node] = []
        self.open: list[tuple[list[Node], Node | None]] = [(self.top, None)]
        self.variables: dict[str, Any] = {}
        self.catalogues: list[str] = []
        self.steps: dict[str, Any] = {}
        #: The files of steps, by their provider name here.
        self.step_files: dict[str, str] = {}
        self.functions: dict[str, tuple[TaskFunction, str, str]] = {}
        #: The parameters and variables of the task.
        self.bindings: dict[str, Binding] = {}
        #: The states outside a list that were referred to from inside it, by that list.
        self._spoken: dict[int, tuple[list[Node], dict[str, Node]]] = {}
        #: Values in texts, by their numbers.
        self._in_texts: dict[int, Value] = {}
        #: Transitions: the state that has it, its target, and the line.
        self._leads: list[tuple[Node, Node, tuple[str, int]]] = []

    @staticmethod
    def now(what: str) -> Trace:
        """The trace that is running."""
        trace = tracing.get()
        if trace is None:
            refuse(f"{what} belongs into a task", "call it in a function with `@ratn.task`")
        return trace

    def add(self, name: str | None, default: str, at: tuple[str, int] | None = None, implied: str | None = None) -> Node:
        """Adds a state; `implied` is its default name."""
        siblings, owner = self.open[-1]
        at = at or user_line()
        frame = user_frame()
        handler = handler_of(*at, {**frame.f_globals, **frame.f_locals})
        if handler is not None:
            kind, line = handler
            refuse(
                f"`except {kind}` around a state catches nothing: a state that fails is known only while the task runs",
                "lead on from how it ends (`transitions={\"aborted\": state}`), or write `with ratn.retry(3):`",
                (at[0], line),
            )
        if name is not None:
            name = literal(name, "a name")
            if name in _NO_NAMES:
                refuse(f"a state cannot be called `{name}`, which means something else in a task file", "give it another name", at)
            outside = self._spoken_in(siblings).get(name)
            if outside is not None:
                self._hidden(outside, at)
        return Node(siblings, owner, name, at, default, implied)

    def _spoken_in(self, siblings: list[Node]) -> dict[str, Node]:
        """The states outside a list that were referred to from inside it."""
        # The list is kept alive, so that no other one gets its address.
        return self._spoken.setdefault(id(siblings), (siblings, {}))[1]

    def name_in_text(self, value: Value) -> int:
        """The number of a value that is named in a text."""
        number = next(_numbers)
        self._in_texts[number] = value
        return number

    def named_in_text(self, number: int) -> Value:
        """The value with this number."""
        value = self._in_texts.get(number)
        if value is None:
            refuse("a text with a value of another task in it", "make the text in the task that uses it")
        return value

    def leads_to(self, node: Node) -> str:
        """The name of a state in a transition of the state that was added last."""
        siblings, _ = self.open[-1]
        if siblings:
            self._leads.append((siblings[-1], node, user_line()))
        return node.named()

    def check_leads(self) -> None:
        """Refuses transitions that do not lead to a sibling of their state."""
        for node, target, at in self._leads:
            if node.siblings is not target.siblings:
                what = f"a transition leads to the state `{target.named()}` of {target.line[0]}:{target.line[1]}, which is not beside the one that has it"
                refuse(what, "lead to a state beside it, or give the block around a transition (`ratn.leave(outcome)` leads out of it)", at)

    def provider_of_steps(self, provider: str, file: str) -> str:
        """The provider name for the steps of a file: two files of the same name are two providers."""
        number, name = 2, provider
        while self.step_files.setdefault(name, file) != file:
            number, name = number + 1, f"{provider}_{number}"
        return name

    def free(self, node: Node | None, name: str) -> str:
        """A variable name that hides no other variable; nor, if `node` exists already, a variable that was named inside `node`."""
        taken = set(self.bindings)
        for _, owner in self.open:
            if owner is not None:
                taken |= {*owner.bindings, *owner.body.get("variables", {})}
        return _free(name, taken if node is None else {*taken, *node.spoken})

    def bind(self, node: Node, name: str, kind: str, at: tuple[str, int]) -> Binding:
        """The variable of this name that a block binds."""
        return node.bindings.setdefault(name, Binding(name, kind, at))

    def declare(self, owner: Node | None, name: str, at: tuple[str, int]) -> Binding:
        """Declares a scoped variable of a block, or of the task."""
        known = self.bindings if owner is None else owner.bindings
        before = known.get(name) or (None if owner is None else owner.spoken.get(name))
        if before is not None or name in (self.variables if owner is None else owner.body.get("variables", {})):
            refuse(f"there is {before or f'a variable `${name}`'} already", "give one of the two another name")
        known[name] = Binding(name, "variable", at)
        return known[name]

    def sees(self, bound: Binding) -> None:
        """Refuses a variable whose name stands for something else at this place."""
        passed: list[Node] = []
        for siblings, owner in reversed(self.open):
            # A variable that it binds is known in its own states, but not in the states before a retry, nor in those of `finally`.
            if owner is None or siblings is owner.before or siblings is owner.branches.get("finally"):
                continue
            if owner.bindings.get(bound.name) is bound:
                break
            if bound.name in owner.bindings or bound.name in owner.body.get("variables", {}):
                bound.hidden_by(str(owner.bindings.get(bound.name) or f"the variable `${bound.name}` of {owner.line[0]}:{owner.line[1]}"))
            passed.append(owner)
        else:
            if self.bindings.get(bound.name) is not bound:
                refuse(f"{bound} is not known here", "it is known inside of what binds it: use it there, or put it out, `ratn.collect(value)`")
        for owner in passed:
            owner.spoken[bound.name] = bound

    def _hidden(self, node: Node, at: tuple[str, int] | None = None) -> NoReturn:
        refuse(
            f"the state `{node.named()}` of {node.line[0]}:{node.line[1]} is hidden here by another one of its name",
            "give one of the two another name (`name=`)",
            at,
        )

    def enter(self, node: Node, branch: str) -> None:
        file, line = user_line()
        # `return`, `break` and `continue` may leave a block that always runs, as in Python.
        jump = None if branch == "states" else jump_out_of_with(file, line)
        if jump is not None:
            word, at = jump
            refuse(
                f"this `{word}` leaves a block that is done only sometimes, and is done always when the task is traced",
                "write what follows in `with ratn.otherwise():`, or lead out with a transition or `ratn.leave(outcome)`",
                (file, at),
            )
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
        """The name of a state's output at this place."""
        inside = scope_of_function()
        if inside is not None:
            refuse(f"`{inside}` sees its parameters and facts only, and uses the state `{node.named()}`", "give it that as another parameter")
        lists = [siblings for siblings, _ in self.open]
        if any(siblings is node.siblings for siblings in lists):
            name = node.named()
            for siblings, around in reversed(self.open):
                if siblings is node.siblings:
                    break
                # Other branches of its own block hide nothing.
                if around is not node.owner:
                    if any(other.name == name for other in siblings):
                        self._hidden(node)
                    self._spoken_in(siblings)[name] = node
            return f"{name}.{port}"
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
        """`either` of some values. If some of them are inside one block, the block puts out the first of them; values of states that come after
        the block stay beside it."""
        around = [self._hides(way) for way in ways]
        hidden = {id(block): block for block in around if block is not None}
        if len(hidden) != 1:
            return f"either({', '.join(map(expression, ways))})"
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
            text = self.first_of(within) if len(within) > 1 else expression(within[0])
        finally:
            del self.open[depth:]
        (port, *_) = _ports(next(way for way, hides in zip(ways, around, strict=True) if hides is not None))
        seen = f"{block.named()}.{block.put_out(text, port.port, f'either_{port.port}')}"
        # The block may have failed, and the failure been handled: then the other values are tried as well.
        others = [way for at, way in enumerate(ways) if at >= first and around[at] is None]
        all_ways = [*map(expression, beside), seen, *map(expression, others)]
        return f"either({', '.join(all_ways)})" if len(all_ways) > 1 else seen

    def _is_behind(self, way: object, block: Node) -> bool:
        """Whether a value belongs to a state that comes after a sibling block."""
        beside = [port.node for port in _ports(way) if port.node.siblings is block.siblings]
        return any(block.siblings.index(node) > block.siblings.index(block) for node in beside)

    def _hides(self, way: object) -> Node | None:
        """The block, a sibling of what is open, that contains a value's state, if any."""
        for port in _ports(way):
            node = port.node
            while not any(siblings is node.siblings for siblings, _ in self.open) and node.owner is not None:
                node = node.owner
            if node is not port.node:
                return node
        return None

    def collects(self) -> int:
        """The position of the innermost loop among what is open."""
        for at, (states, owner) in reversed(list(enumerate(self.open))):
            if owner is not None and states is owner.branches.get("do"):
                return at
        refuse("`ratn.collect` outside of a loop", "write it inside of `for x in ratn.each(list):`, or of another loop")


class Port:
    """An output of a state, written by its name at the place of use."""

    def __init__(self, node: Node, port: str) -> None:
        self.node, self.port = node, port

    def _text(self) -> str:
        return Trace.now(f"`{self.node.named()}.{self.port}`").seen(self.node, self.port)


class Either:
    """The first of several values that was written on the path taken."""

    def __init__(self, ways: Sequence[object]) -> None:
        self.ways = ways

    def _text(self) -> str:
        return Trace.now("`fn.either`").first_of(self.ways)


def _ports(value: object) -> list[Port]:
    """The outputs that a value depends on."""
    if isinstance(value, Port):
        return [value]
    if isinstance(value, Either):
        return [port for way in value.ways for port in _ports(way)]
    if isinstance(value, dict):
        return _ports(list(value.values()))
    if isinstance(value, Within):
        return _ports(value.value)
    parts = value._parts if isinstance(value, Value) else value if isinstance(value, (list, tuple)) else ()
    return [port for part in parts for port in _ports(part)]


class State:
    """A state of a task. Its outputs are its attributes, ``look.boxes``; in ``transitions`` it can be used as a target."""

    __slots__ = ("_node",)
    _is_state = True
    #: The state's outcome, as the ``decide`` of a concurrency sees it for its regions.
    outcome: Value

    def __init__(self, node: Node) -> None:
        self._node = node

    if not typing.TYPE_CHECKING:
        # For type checkers, a state has the outputs that stubs declare.
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
    """A state whose outputs type checkers do not know."""

    __slots__ = ()
    if typing.TYPE_CHECKING:

        def __getattr__(self, name: str) -> Value: ...


def assigned_name(function: str, at: tuple[str, int]) -> str | None:
    """The variable to which the call at a line is assigned, ``look = detector.segment(…)``: the state gets the same name."""
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
