"""Tasks in plain sequential Python, traced once into the same model as a task file.

``@ratn.task`` calls the function once, with its parameters as values that are known only while the task runs. Each call of an action adds a
state, each ``with`` block and each ``ratn.each`` a state with states inside. What comes out is the tree of a task file; what it means,
and what is wrong with it, is decided by the same code as for YAML.
"""

from __future__ import annotations

import ast
import contextvars
import inspect
import json
import os
import pathlib
import subprocess
import tempfile
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from ratn import _ports, _ratn, _source, _yaml
from ratn._expression import Untraceable, Value, call, refuse, statements_at_work, user_frame, user_line, written
from ratn._ratn import Error, InvalidTask
from ratn._yaml import Body

class Annotations(typing.TypedDict, total=False):
    """What is said of a state that performs an action, as keyword arguments: the keys of a task file."""

    name: str | None
    inputs: Mapping[str, object]
    description: str
    out: Any
    computes: bool
    senses: Sequence[str | Value]
    pia: bool
    deterministic: bool
    reads: Sequence[str | Value]
    requires: Sequence[str | Value]
    effects: Any
    resources: Any
    duration: float | Value
    attempts: int
    timeout: float
    holds: Sequence[str | Value]
    retry: int | Mapping[str, Any]
    transitions: Mapping[str, str | State]
    exceptional: Sequence[str]
    exceptions: str
    assign: Mapping[str, object]
    shared: Sequence[str | Value]


#: Keys of a state beside those that say what it is, as keyword arguments.
ANNOTATIONS = (
    *(key for key in Annotations.__annotations__ if key not in ("name", "inputs")),
    "outcomes", "variables", "outputs", "routine", "decide",
)
#: Annotations that are expressions, or have some within: a text of Python is a text there, and not an expression.
_VALUES = {"duration", "variables", "assign", "outputs", "decide"}

_KEYS = {name: key for key, name in _source.RENAMED.items()}

_tracing: contextvars.ContextVar[Trace | None] = contextvars.ContextVar("ratn_tracing", default=None)


def entry(value: object) -> Any:
    """A value of Python where a task file has an expression."""
    if value is None or isinstance(value, (bool, int, float)) and not hasattr(value, "tolist"):
        return value
    if isinstance(value, dict):
        return {str(name): entry(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [entry(item) for item in value]
    return str(written(value))


def raw(value: object) -> Any:
    """What is in a task file's own words: texts as they are, values as their expressions, states as their names."""
    if isinstance(value, State):
        return value._node.name
    if isinstance(value, Value):
        return str(value)
    if isinstance(value, dict):
        return {str(raw(name)): raw(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [raw(item) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(written(value))


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

    @property
    def shows_outputs(self) -> bool:
        """Whether states inside are seen from outside, through outputs."""
        return "states" in self.branches or "regions" in self.branches

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
        trace = _tracing.get()
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
        if node.siblings is owner.before or not owner.shows_outputs:
            where = f"{owner.line[0]}:{owner.line[1]}"
            refuse(
                f"`{node.named()}` is not seen outside of the block that begins at {where}",
                "a loop, a condition or a `before` has no outputs: let an effect say it as a fact, and read that",
            )
        if port == "outcome":
            refuse(f"how `{node.named()}` ended is seen only beside it", "let an effect say it as a fact, or give the block around an outcome")
        outputs = owner.body.setdefault("outputs", {})
        text = f"{node.named()}.{port}"
        known = [name for name, said in outputs.items() if said == text]
        name = known[0] if known else port if port not in outputs else f"{node.named()}_{port}"
        outputs[name] = text
        return self.seen(owner, name)


class Port:
    """An output of a state, named as it is seen where it is written down."""

    def __init__(self, node: Node, port: str) -> None:
        self.node, self.port = node, port

    def __str__(self) -> str:
        return Trace.now(f"`{self.node.named()}.{self.port}`").seen(self.node, self.port)


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


def _assigned(function: str, at: tuple[str, int]) -> str | None:
    """The variable that the call at a line is assigned to, ``look = detector.segment(…)``: its state is called so, too."""
    for node in statements_at_work(*at):
        if isinstance(node, ast.NamedExpr) and _calls(node.value, function):
            return node.target.id
        if isinstance(node, ast.Assign) and len(node.targets) == 1 and _calls(node.value, function):
            target = node.targets[0]
            return target.id if isinstance(target, ast.Name) else None
        if isinstance(node, ast.With):
            for item in node.items:
                if _calls(item.context_expr, function) and isinstance(item.optional_vars, ast.Name):
                    return item.optional_vars.id
    return None


def _calls(node: ast.expr, function: str) -> bool:
    if not isinstance(node, ast.Call):
        return False
    name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id if isinstance(node.func, ast.Name) else ""
    return name == function


def annotate(body: dict[str, Any], said: dict[str, Any]) -> None:
    """Adds annotations, as keyword arguments say them."""
    for key, value in said.items():
        if key not in ANNOTATIONS:
            known = ", ".join(ANNOTATIONS)
            raise TypeError(f"there is no annotation `{key}`; there are {known}")
        if value is None:
            continue
        key = _KEYS.get(key, key)
        if key in _VALUES:
            body[key] = _outputs(value) if key == "outputs" else entry(value)
        elif key == "resources" or isinstance(value, (list, tuple, set, frozenset)):
            body[key] = [raw(item) for item in (value if isinstance(value, (list, tuple, set, frozenset)) else [value])]
        else:
            body[key] = raw(value)


def _outputs(outputs: dict[str, Any]) -> dict[str, Any]:
    return {name: value.entry() if isinstance(value, Output) else entry(value) for name, value in outputs.items()}


@dataclass
class Output:
    """An output with a type, and what it is where it was not written: ``ratn.output(n, type="int")``."""

    value: object
    type: str | None = None
    default: object = None
    has_default: bool = False
    description: str | None = None

    def entry(self) -> dict[str, Any]:
        said: dict[str, Any] = {"value": entry(self.value)}
        if self.type is not None:
            said["type"] = self.type
        if self.has_default:
            said["default"] = entry(self.default)
        if self.description is not None:
            said["description"] = self.description
        return said


_NOTHING = object()


def output(value: object, *, type: str | None = None, default: object = _NOTHING, description: str | None = None) -> Output:
    """An output of a task or block with a type, a default or a description."""
    return Output(value, type, None if default is _NOTHING else default, default is not _NOTHING, description)


def block(kind: str, **said: Any) -> dict[str, Any]:
    """A resource to itself while the state runs: ``ratn.block("Arm", count=1, where={"tool": "welder"})``."""
    return {"block": kind, **said}


def consume(kind: str, **said: Any) -> dict[str, Any]:
    """A resource for the rest of the run: ``ratn.consume("Battery", count=0.2)``."""
    return {"consume": kind, **said}


def create(kind: str, **said: Any) -> dict[str, Any]:
    """A resource of the task that there is once the state has become real."""
    return {"create": kind, "class": "task", **said}


def delete(kind: str, **said: Any) -> dict[str, Any]:
    """A resource of the task that there is no more once the state has become real."""
    return {"delete": kind, **said}


def perform(
    action: str, inputs: dict[str, Any], annotations: dict[str, Any], *, name: str | None = None, kind: str | None = None
) -> AnyState:
    """Adds a state that performs ``provider/action``. Where nobody says its resources, it blocks one of ``kind``, which performs it."""
    at = user_line()
    trace = Trace.now(f"`{action}`")
    function = action.rpartition("/")[2]
    node = trace.add(name or _assigned(function, at) or function, function, at)
    node.body["action"] = action
    if inputs:
        node.body["in"] = {port: entry(value) for port, value in inputs.items()}
    annotate(node.body, annotations)
    if kind is not None and "resources" not in annotations:
        reads_world = node.body.get("computes") is True and node.body.get("reads", True) != []
        node.body["resources"] = [kind, "world_model"] if reads_world else [kind]
    return AnyState(node)


class Provider:
    """The actions of a provider as functions: ``arm.follow(trajectory=…, pia=True)``. Ports and annotations are keyword arguments."""

    def __init__(self, name: str, provider: dict[str, Any], catalogue: str | None) -> None:
        self._name, self._provider, self._catalogue = name, provider, catalogue

    def __getattr__(self, name: str) -> Callable[..., AnyState]:
        if name.startswith("_"):
            raise AttributeError(name)
        actions = self._provider.get("actions", {})
        if name not in actions:
            raise AttributeError(f"`{self._name}` has no action `{name}`; it has {', '.join(sorted(actions))}")
        return lambda *positional, **said: self._call(name, positional, said)

    def __dir__(self) -> list[str]:
        return sorted(self._provider.get("actions", {}))

    def _call(self, action: str, positional: tuple[Any, ...], said: dict[str, Any]) -> AnyState:
        if positional:
            raise TypeError(f"`{self._name}.{action}` takes its inputs by name: `{action}(port=value)`")
        trace = Trace.now(f"`{self._name}.{action}`")
        if self._catalogue is not None and self._catalogue not in trace.catalogues:
            trace.catalogues.append(self._catalogue)
        signature = self._provider["actions"][action]
        ports = {*signature.get("inputs", {}), *signature.get("optional", {})}
        name = said.pop("name", None) if "name" not in ports else None
        inputs = dict(said.pop("inputs", {})) if "inputs" not in ports else {}
        for key in list(said):
            # Where a port has the name of an annotation, the port is meant by `inputs={…}` only.
            if key not in ANNOTATIONS:
                if key not in ports:
                    known = ", ".join(sorted(ports)) or "none"
                    raise TypeError(f"`{self._name}.{action}` has no input `{key}`; it has {known}. Annotations are {', '.join(ANNOTATIONS)}")
                inputs[key] = said.pop(key)
        # What the catalogue says that the action blocks is in force where the state says nothing.
        kind = None if signature.get("annotations", {}).get("resources") else self._provider["resource"]
        return perform(f"{self._name}/{action}", inputs, said, name=name, kind=kind)


def action(name: str, /, inputs: dict[str, Any] | None = None, **annotations: Any) -> AnyState:
    """A state that performs an action by its name, ``ratn.action("arm/follow", {"trajectory": plan.trajectory}, pia=True)``."""
    state_name = annotations.pop("name", None)
    return perform(name, inputs or {}, annotations, name=state_name)


def library(file: str | os.PathLike[str], *, name: str | None = None, **given: Any) -> AnyState:
    """Another task file as a state; what is no annotation is a parameter: ``ratn.library("fetch_boxes.yaml", boxes=2)``."""
    at = user_line()
    trace = Trace.now("`ratn.library`")
    node = trace.add(name or _assigned("library", at) or pathlib.Path(file).stem, "library", at)
    node.body["library"] = os.fspath(file)
    parameters = {**given.pop("parameters", {}), **{key: given.pop(key) for key in list(given) if key not in ANNOTATIONS}}
    if parameters:
        node.body["with"] = {key: entry(value) for key, value in parameters.items()}
    annotate(node.body, given)
    return AnyState(node)


def leave(outcome: str, *, name: str | None = None) -> State:
    """A step out of the block around by one of its outcomes."""
    trace = Trace.now("`ratn.leave`")
    node = trace.add(name or f"leave_{outcome}", "leave")
    node.body.update({"states": [], "transitions": {"success": outcome}})
    return State(node)


def wait(
    condition: object = None,
    *,
    seconds: object = None,
    until: object = None,
    signal: str | None = None,
    timeout: float | None = None,
    name: str | None = None,
    **annotations: Any,
) -> AnyState:
    """Waits for a condition on the world, for a time, or for a signal; nothing is held meanwhile.

    ``ratn.wait(ratn.fact("open", "lid"), timeout=60)``, ``ratn.wait(seconds=0.5)``, ``ratn.wait(until=30)`` (seconds since the run began), and
    ``order = ratn.wait(signal="order")``, of which ``order.value`` is what ``run.signal("order", 2)`` has sent. After ``timeout`` seconds the
    outcome is ``timeout``.
    """
    given = {"for": condition, "seconds": seconds, "until": until, "signal": signal}
    said = {key: value for key, value in given.items() if value is not None}
    if len(said) != 1:
        refuse("a state waits for one thing", "say a condition, `seconds=`, `until=` or `signal=`")
    ((key, value),) = said.items()
    body = {key: value if isinstance(value, str) else entry(value)}
    if timeout is not None:
        body["timeout"] = timeout
    return _own("wait", name, f"wait_{'condition' if key == 'for' else key}", body, annotations)


def ask(
    question: object, choices: Iterable[str], *, default: str | None = None, timeout: float | None = None, name: str | None = None, **annotations: Any
) -> AnyState:
    """Asks an operator, who answers with ``ratn answer`` or ``run.answer("now")``: ``go_on = ratn.ask("May the arm move?", ["now", "never"])``.

    ``go_on.answer`` is the choice. One that ``transitions`` name is an outcome. After ``timeout`` seconds the answer is ``default``, or the outcome
    ``timeout`` without one.
    """
    text = str(question)
    if isinstance(question, Value) and not text.startswith(("'", '"', "$", "concat(")):
        text = f"concat({text})"
    elif not isinstance(question, Value) and text.startswith(("'", '"', "$", "concat(")):
        # As a sentence, and not as an expression.
        text = json.dumps(text, ensure_ascii=False)
    body: dict[str, Any] = {"question": text, "choices": list(choices)}
    if default is not None:
        body["default"] = default
    if timeout is not None:
        body["timeout"] = timeout
    return _own("ask", name, "ask_operator", body, annotations)


def _own(function: str, name: str | None, default: str, body: dict[str, Any], annotations: dict[str, Any]) -> AnyState:
    """A state that task control executes itself."""
    at = user_line()
    trace = Trace.now(f"`ratn.{function}`")
    node = trace.add(name or _assigned(function, at) or default, default, at)
    node.body[function] = body
    annotate(node.body, annotations)
    return AnyState(node)


class TaskFunction:
    """A function of expressions, of a task: see :func:`function`."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._name = function, function.__name__
        self._parameters = list(inspect.signature(function).parameters)
        self._is_traced = False

    def __call__(self, *arguments: Any) -> Value:
        trace = Trace.now(f"`{self._name}`")
        if len(arguments) != len(self._parameters):
            raise TypeError(f"`{self._name}` takes {len(self._parameters)} arguments ({', '.join(self._parameters)}), and is given {len(arguments)}")
        if self._is_traced:
            refuse(f"`{self._name}` uses itself", "write it without: a function is what would stand there if it were written out")
        known = trace.functions.get(self._name)
        if known is None or known[0] is not self:
            if known is not None:
                refuse(f"there are two functions `{self._name}`", "give one another name")
            self._is_traced = True
            try:
                body = str(written(self._function(*(Value(f"${parameter}") for parameter in self._parameters))))
            finally:
                self._is_traced = False
            head = f"{self._name}({', '.join(f'${parameter}' for parameter in self._parameters)})"
            trace.functions[self._name] = (self, head, body)
        return call(self._name, *arguments)


def function(function: Callable[..., Any]) -> TaskFunction:
    """Makes a function one of the task file: written once, used in expressions, ``near(box.pose, table)``. It sees its parameters and facts only."""
    return TaskFunction(function)


class Block(AnyState):
    """A ``with`` block: a state with states inside."""

    __slots__ = ("_branch", "_trace")
    _FORM: str = "states"

    def __init__(self, function: str, name: str | None, annotations: dict[str, Any], head: dict[str, Any], default: str) -> None:
        at = user_line()
        trace = Trace.now(f"`ratn.{function}`")
        node = trace.add(name or _assigned(function, at), default, at)
        node.body.update(head)
        annotate(node.body, annotations)
        node.branches[self._FORM] = []
        self._trace, self._branch = trace, self._FORM
        super().__init__(node)

    def __enter__(self) -> Any:
        self._trace.enter(self._node, self._branch)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._trace.leave(self._node)

    def _say(self, key: str, said: dict[str, Any]) -> None:
        """Something about what is inside, said inside or after it."""
        inside = (self._node.branches[self._FORM], self._node)
        is_open = any(one[0] is inside[0] for one in self._trace.open)
        if not is_open:
            self._trace.open.append(inside)
        try:
            self._node.body.setdefault(key, {}).update(_outputs(said) if key == "outputs" else entry(said))
        finally:
            if not is_open:
                self._trace.open.pop()


class Ordered(Block):
    """States in order, as one state."""

    __slots__ = ()

    def outputs(self, **outputs: Any) -> None:
        """What is seen of it outside: ``think.outputs(way=plan.trajectory)``. What is used outside is seen without that, too."""
        self._say("outputs", outputs)


class Retry(Ordered):
    """What is tried again. A block of one action, without ``name=``, is that action with a ``retry``."""

    __slots__ = ("_is_named",)
    _is_named: bool

    def before(self) -> _Before:
        """What is done before each further try: ``with attempt.before():``."""
        return _Before(self._trace, self._node)

    def __exit__(self, kind: object, *exception: object) -> None:
        super().__exit__(kind, *exception)
        node = self._node
        inside = node.branches["states"]
        own = node.body.keys() - {"retry", "resources"}
        if kind is not None or self._is_named or own or node.body.get("resources") or len(inside) != 1:
            return
        (single,) = inside
        is_free = single.name not in {other.name for other in node.siblings if other is not node}
        if "action" in single.body and "retry" not in single.body and is_free:
            single.body["retry"], single.before = node.body["retry"], node.before
            single.siblings, single.owner = node.siblings, node.owner
            node.siblings[node.siblings.index(node)] = single
            self._node = single


class _Before:
    def __init__(self, trace: Trace, node: Node) -> None:
        self._trace, self._node = trace, node
        self._outside: list[tuple[list[Node], Node | None]] = []

    def __enter__(self) -> None:
        trace, node = self._trace, self._node
        if node.before is not None:
            refuse("there is a `before` of this retry already", "put all that is done before another try into one block")
        node.before = []
        # It is not inside of what is tried again, and sees nothing of it.
        at = next((index for index, (_, owner) in enumerate(trace.open) if owner is node), len(trace.open))
        self._outside, trace.open[at:] = trace.open[at:], [(node.before, node)]

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._trace.open[-1:] = self._outside


class Condition(Block):
    """What is done where something is true; :func:`otherwise` is the other branch."""

    __slots__ = ()
    _FORM = "then"


class Loop(Block):
    """What is done again and again."""

    __slots__ = ("_key", "_index")
    _FORM = "do"
    _key: str
    _index: str | None

    def test(self, condition: object) -> None:
        """The condition, said inside: it may speak of the states in the loop."""
        self._node.body[self._key] = condition if isinstance(condition, str) else entry(condition)

    @property
    def index(self) -> Value:
        """The number of the iteration, from 0."""
        if self._index is None:
            self._index = str(self._node.body.setdefault("index", "iteration"))
        return Value(f"${self._index}")

    def __exit__(self, kind: object, *exception: object) -> None:
        super().__exit__(kind, *exception)
        if kind is None and self._key not in self._node.body:
            refuse("a loop without a condition", "say it as `ratn.until(condition)`, or inside as `loop.test(condition)`", self._node.line)


class Concurrency(Block):
    """Regions that run at the same time: each state inside is one."""

    __slots__ = ()
    _FORM = "regions"

    def outputs(self, **outputs: Any) -> None:
        """What is seen of it outside."""
        self._say("outputs", outputs)

    def decide(self, **outcomes: Any) -> None:
        """Its outcome is the first whose condition holds: ``both.decide(blind=head.outcome == "aborted")``."""
        self._say("decide", outcomes)


def sequence(name: str | None = None, **annotations: Any) -> Ordered:
    """States in order as one state: ``with ratn.sequence("think", routine=True) as think:``."""
    return Ordered("sequence", name, annotations, {}, "sequence")


def retry(
    times: int | None = None, *, on: Iterable[str] | None = None, backoff: float | None = None, name: str | None = None, **annotations: Any
) -> Retry:
    """What is inside is tried again, so many times after the first: ``with ratn.retry(3):``.

    ``on`` are the outcomes after which it is (``aborted`` unless given), ``backoff`` the seconds before the second try.
    """
    said: dict[str, Any] = {} if times is None else {"times": times}
    if backoff is not None:
        said["backoff"] = backoff
    if on is not None:
        said["on"] = list(on)
    attempt = Retry("retry", name, annotations, {"retry": said}, "retry")
    attempt._is_named = name is not None
    return attempt


def _condition(condition: object) -> Any:
    return condition if isinstance(condition, str) else entry(condition)


def when(condition: object, *, name: str | None = None, **annotations: Any) -> Condition:
    """What is inside is done where the condition is true: ``with ratn.when(fn.len(look.boxes) > 0):``. A text is an expression."""
    return Condition("when", name, annotations, {"condition": _condition(condition)}, "condition")


class _Otherwise:
    def __init__(self) -> None:
        trace = Trace.now("`ratn.otherwise`")
        siblings, _ = trace.open[-1]
        if not siblings or "then" not in siblings[-1].branches or "else" in siblings[-1].branches:
            refuse("`ratn.otherwise` without `ratn.when`", "write it right behind the block of `with ratn.when(…):`")
        self._trace, self._node = trace, siblings[-1]

    def __enter__(self) -> None:
        self._trace.enter(self._node, "else")

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._trace.leave(self._node)


def otherwise() -> _Otherwise:
    """What is done where the condition of the ``ratn.when`` before it is not true."""
    return _Otherwise()


class Each(Iterator[Any]):
    """A loop over a list; its body is traced once."""

    def __init__(self, elements: object, variable: str | None, index: str | bool | None, name: str | None, annotations: dict[str, Any]) -> None:
        at = user_line()
        self._trace = Trace.now("`ratn.each`")
        targets = self._targets(at)
        if index is True:
            self._index: str | None = targets[0] if len(targets) == 2 else "index"
        else:
            self._index = index or None
        if variable is None and not targets and statements_at_work(*at):
            refuse("`ratn.each` outside of a `for`", "write `for x in ratn.each(list):`; of a list of values make another with `fn.map(list, lambda x: …)`", at)
        self._variable = variable or (targets[-1] if targets else "element")
        node = self._trace.add(name, f"for_{self._variable}", at)
        text = elements if isinstance(elements, str) else str(written(elements))
        node.body["for"] = f"{self._variable} in {text}"
        if self._index:
            node.body["index"] = self._index
        annotate(node.body, annotations)
        node.branches["do"] = []
        self._node, self._has_begun, self._gives_index = node, False, index is True

    @staticmethod
    def _targets(at: tuple[str, int]) -> list[str]:
        for node in statements_at_work(*at):
            if isinstance(node, ast.comprehension):
                refuse("states are not made in a comprehension", "write `for x in ratn.each(list):` as a statement", at)
            if isinstance(node, ast.For) and _calls(node.iter, "each"):
                names = node.target.elts if isinstance(node.target, ast.Tuple) else [node.target]
                return [name.id for name in names if isinstance(name, ast.Name)]
        return []

    def __iter__(self) -> Each:
        return self

    def __next__(self) -> Any:
        if self._has_begun:
            self._trace.leave(self._node)
            raise StopIteration
        self._has_begun = True
        self._trace.enter(self._node, "do")
        element = Value(f"${self._variable}")
        return (Value(f"${self._index}"), element) if self._gives_index else element


def each(elements: object, *, variable: str | None = None, index: str | bool | None = None, name: str | None = None, **annotations: Any) -> Each:
    """The elements of a list that is known only while the task runs: ``for box in ratn.each(look.boxes):``.

    With ``index=True`` also their numbers: ``for i, box in ratn.each(look.boxes, index=True):``.
    """
    return Each(elements, variable, index, name, annotations)


def _loop(key: str, function: str, condition: object, index: str | None, name: str | None, annotations: dict[str, Any]) -> Loop:
    head = {} if condition is None else {key: _condition(condition)}
    loop = Loop(function, name, annotations, {**head, **({"index": index} if index else {})}, function.rstrip("_"))
    loop._key, loop._index = key, index
    return loop


def while_(condition: object, *, index: str | None = None, name: str | None = None, **annotations: Any) -> Loop:
    """What is inside is done while the condition is true, which is looked at before each time: ``with ratn.while_(tries < 3) as loop:``."""
    return _loop("while", "while_", condition, index, name, annotations)


def do_while(condition: object = None, *, index: str | None = None, name: str | None = None, **annotations: Any) -> Loop:
    """As :func:`while_`, looked at after each time."""
    return _loop("do_while", "do_while", condition, index, name, annotations)


def until(condition: object = None, *, index: str | None = None, name: str | None = None, **annotations: Any) -> Loop:
    """What is inside is done until the condition is true, which is looked at after each time."""
    return _loop("until", "until", condition, index, name, annotations)


def concurrently(kind: str = "barrier", *, name: str | None = None, **annotations: Any) -> Concurrency:
    """Regions: each state inside is one. ``barrier`` waits for all, ``preemptive`` ends with the first."""
    return Concurrency("concurrently", name, annotations, {"concurrency": kind}, "concurrency")


def variable(value: object, *, name: str | None = None) -> Value:
    """A scoped variable of the task or block around: ``tries = ratn.variable(0)``. States give it new values with ``assign``."""
    at = user_line()
    trace = Trace.now("`ratn.variable`")
    called = name or _assigned("variable", at)
    if called is None:
        refuse("a variable has a name", "write `tries = ratn.variable(0)`, or `ratn.variable(0, name=\"tries\")`")
    owner = trace.open[-1][1]
    if owner is not None and "states" not in owner.branches:
        refuse("variables belong to the task or to a `ratn.sequence`", "say it before the block, or in a `with ratn.sequence():` inside of it")
    variables = trace.variables if owner is None else owner.body.setdefault("variables", {})
    variables[called] = entry(value)
    return Value(f"${called}")


@dataclass(frozen=True)
class Finding:
    """Something that is wrong with a task, with the line of the file that says it."""

    rule: str
    severity: str
    file: str
    line: int
    path: str
    message: str
    help: str

    def __str__(self) -> str:
        path = f" in {self.path}" if self.path else ""
        help_ = f". help: {self.help}" if self.help else ""
        return f"{self.file}:{self.line}: {self.severity}[{self.rule}]{path}: {self.message}{help_}"


class Task:
    """A task: the tree of a task file, traced of a Python function or read from YAML."""

    def __init__(
        self,
        document: dict[str, Any],
        *,
        folder: pathlib.Path,
        file: str,
        catalogues: Iterable[str] = (),
        steps: dict[str, Any] | None = None,
        source: str | None = None,
    ) -> None:
        #: The tree, as dicts and lists.
        self.document = document
        #: What the paths of libraries and the ontology are relative to.
        self.folder = folder
        self._file, self._catalogues, self._steps = file, list(catalogues), dict(steps or {})
        self._source = source

    @property
    def name(self) -> str:
        """Its name."""
        return str(self.document.get("task", ""))

    @property
    def parameters(self) -> dict[str, Any]:
        """Its parameters, as a task file has them."""
        return dict(self.document.get("parameters") or {})

    def __repr__(self) -> str:
        return f"<Task {self.name} of {self._file}>"

    def _repr_markdown_(self) -> str:
        return f"```yaml\n{self.to_yaml()}```"

    @staticmethod
    def from_yaml(source: str | os.PathLike[str]) -> Task:
        """Reads a task file, or the text of one (which has a line end)."""
        if isinstance(source, str) and "\n" in source:
            text, file, folder = source, "<text>", pathlib.Path.cwd()
        else:
            path = pathlib.Path(source)
            text, file, folder = path.read_text(), str(path), path.resolve().parent
        document = _ratn.read_yaml(text, file)
        if not isinstance(document, dict):
            raise InvalidTask(f"{file}:1: a task file is a mapping: begin it with `task: name`")
        return Task(document, folder=folder, file=file, source=text)

    def to_yaml(self, path: str | os.PathLike[str] | None = None) -> str:
        """The text of a task file with the same meaning, which is written to ``path``, too, where that is given.

        Comments, and what is written between lines, are not kept. Paths in it stay relative to ``folder``, or to that of the file
        that was read.
        """
        text = "\n".join(_yaml.write(self.document).text) + "\n"
        if path is not None:
            pathlib.Path(path).write_text(text)
        return text

    def to_python(self) -> str:
        """Python of which the same task can be traced: to go on with a task file in Python."""
        return _source.python_of(self.document)

    def _lines(self) -> _yaml.Lines:
        """Its text, which is that of the file as long as nobody has changed what was read."""
        if self._source is not None and _ratn.read_yaml(self._source, self._file) == self.document:
            lines = _yaml.Lines()
            lines.text = self._source.splitlines()
            return lines
        return _yaml.write(self.document)

    def standing_alone(self) -> str:
        """The text with paths that are valid everywhere."""
        return "\n".join(self._standing_alone().text) + "\n"

    def _standing_alone(self) -> _yaml.Lines:
        document = dict(self.document)
        if isinstance(document.get("ontology"), str):
            document["ontology"] = str(self.folder / document["ontology"])
        document["states"] = [self._rooted(state) for state in document.get("states") or []]
        return _yaml.write(document)

    def _rooted(self, value: Any) -> Any:
        if isinstance(value, dict):
            # What is an expression is no path.
            rooted = Body({key: item if key in ("in", "with", *_VALUES) else self._rooted(item) for key, item in value.items()})
            rooted.line = getattr(value, "line", None)
            if isinstance(value.get("library"), str):
                rooted["library"] = str(self.folder / value["library"])
            return rooted if rooted.line is not None else dict(rooted)
        return [self._rooted(item) for item in value] if isinstance(value, list) else value

    def _read(self) -> tuple[list[Finding], dict[str, Any] | None]:
        lines = self._lines()
        catalogues = [*self._catalogues, *(step.catalogue() for step in self._steps.values())]
        said, model = _ratn.check_task("\n".join(lines.text) + "\n", str(self.folder / pathlib.Path(self._file).name), catalogues)
        findings = [self._finding(one, lines) for one, _ in json.loads(said)]
        return findings, None if model is None else json.loads(model)

    def _finding(self, said: dict[str, Any], lines: _yaml.Lines, name: str | None = None) -> Finding:
        file, line = said["file"], said["location"]["line"]
        if pathlib.Path(file).name == (name or pathlib.Path(self._file).name):
            file, line = lines.origin(line) or (self._file, line)
        return Finding(said["rule"], said["severity"], file, line, said["path"], said["message"], said["help"])

    def check(self, *, system: object = None, config: str | os.PathLike[str] | None = None) -> list[Finding]:
        """What ``ratn check`` notices, with the lines of the Python file; a task that is refused raises ``ratn.InvalidTask``.

        It is checked against the built-in catalogue, those of the modules of actions that it uses, and its own steps; with a ``system`` (a
        ``ratn.System``, or a runtime directory) against what that offers and its workers say of themselves, with a ``config`` against that.
        """
        if system is not None or config is not None:
            return self._check_with(system, config)
        findings, model = self._read()
        if model is None:
            raise invalid(findings)
        return findings

    def _check_with(self, system: object, config: str | os.PathLike[str] | None) -> list[Finding]:
        """As ``ratn check`` does it, which knows what a system is."""
        from ratn._system import _program

        lines = self._standing_alone()
        with tempfile.TemporaryDirectory(prefix="ratn-check-") as folder:
            file = pathlib.Path(folder) / pathlib.Path(self._file).with_suffix(".yaml").name
            file.write_text("\n".join(lines.text) + "\n")
            command = [_program(), "check", str(file), "--no-simulation", "--json"]
            for number, catalogue in enumerate([*self._catalogues, *(step.catalogue() for step in self._steps.values())]):
                (pathlib.Path(folder) / f"{number}.toml").write_text(catalogue)
                command += ["--catalogue", str(pathlib.Path(folder) / f"{number}.toml")]
            command += ["--config", os.fspath(config)] if config is not None else []
            command += ["--runtime-dir", str(getattr(system, "runtime_dir", system))] if system is not None else []
            told = subprocess.run(command, capture_output=True, text=True)
        if not told.stdout.strip():
            raise Error(told.stderr.strip() or f"`ratn check` has ended with code {told.returncode}")
        said = json.loads(told.stdout)
        findings = [self._finding(one, lines, file.name) for one in said["findings"]]
        # Whoever performs steps comes with the run.
        kinds = [f"`{step.kind}`" for step in self._steps.values()]
        workers = [what for what in said["workers"] if not any(kind in what for kind in kinds)]
        findings += [Finding("worker", "warning", self._file, 1, "", what, "") for what in workers]
        if said["task"] is None:
            raise invalid(findings)
        return findings

    def model(self) -> dict[str, Any]:
        """The model that every part of the system works with, as dicts and lists; two tasks are the same where these are equal."""
        findings, model = self._read()
        if model is None:
            raise invalid(findings)
        model.pop("digest")
        for state in model["states"]:
            state.pop("location")
        return model


def invalid(findings: list[Finding]) -> InvalidTask:
    """The exception for findings of which one refuses the task."""
    raised = InvalidTask("\n".join(map(str, findings)))
    raised.findings = findings
    return raised


def task(
    function: Callable[..., Any] | None = None,
    *,
    name: str | None = None,
    **said: Any,
) -> Any:
    """Makes a function a task: it is called once, now, and what it does is what the task does.

    Its parameters are the task's, typed by their annotations (a default makes one optional); the dict that it returns is the task's outputs; the
    first paragraph of its docstring is the description. Keyword arguments are keys of a task file: ``horizon``, ``speculation_width``,
    ``deadline``, ``exceptions``, ``ontology``, ``tolerance``, ``world``, ``outcomes``, ``variables``, ``functions``, ``description``.
    """
    if function is None:
        return lambda function: task(function, name=name, **said)
    return _traced(function, name or function.__name__, said)


_TASK_KEYS = ("description", "horizon", "speculation_width", "deadline", "exceptions", "ontology", "tolerance", "world", "outcomes", "variables", "functions")


def _traced(function: Callable[..., Any], name: str, said: dict[str, Any]) -> Task:
    unknown = [key for key in said if key not in _TASK_KEYS]
    if unknown:
        raise TypeError(f"`@ratn.task` has no `{unknown[0]}`; it has {', '.join(('name', *_TASK_KEYS))}")
    if _tracing.get() is not None:
        refuse("a task within a task", "call a plain function, which is traced as if it stood here, or use `ratn.library(file)`")
    file = function.__code__.co_filename
    if not isinstance(function, types.FunctionType) or inspect.iscoroutinefunction(function) or inspect.isgeneratorfunction(function):
        refuse("a task is a plain function", "write `def`, without `async` and `yield`", (file, function.__code__.co_firstlineno))
    trace = Trace(file)
    document = Body({"task": name})
    document.line = (file, function.__code__.co_firstlineno)
    description = said.pop("description", None) or (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ")
    if description:
        document["description"] = description
    # Annotations may be texts, and name what stands beside the function within another one.
    hints = typing.get_type_hints(function, localns={**user_frame().f_locals}, include_extras=True)
    parameters, given = _parameters(function, hints)
    token = _tracing.set(trace)
    try:
        returned = function(**given)
        if len(trace.open) > 1:
            trace.unfinished(trace.open[-1][1])
        outputs = _returned(function, returned, hints.get("return"))
        document.update({key: _said(key, said[key]) for key in _TASK_KEYS if said.get(key) is not None})
        if trace.functions:
            document["functions"] = {**document.get("functions", {}), **{head: body for _, head, body in trace.functions.values()}}
        if trace.variables:
            document["variables"] = {**document.get("variables", {}), **trace.variables}
        if parameters:
            document["parameters"] = parameters
        if outputs:
            document["outputs"] = outputs
        document["states"] = [node.item() for node in trace.top]
    finally:
        _tracing.reset(token)
    path = pathlib.Path(file)
    folder = path.resolve().parent if path.exists() else pathlib.Path.cwd()
    return Task(document, folder=folder, file=file, catalogues=trace.catalogues, steps=trace.steps)


def _said(key: str, value: Any) -> Any:
    if key == "variables":
        return entry(value)
    if key == "ontology":
        return os.fspath(value)
    return [raw(item) for item in value] if key in ("world", "outcomes") else raw(value)


def _returned(function: Callable[..., Any], returned: object, hint: Any) -> dict[str, Any]:
    if returned is None:
        return {}
    at = (function.__code__.co_filename, function.__code__.co_firstlineno)
    if not isinstance(returned, dict):
        refuse(f"the task returns a {type(returned).__name__}", "return a dict of its outputs, `return {\"visited\": …}`", at)
    kinds = {}
    if typing.is_typeddict(hint):
        kinds = {field: _ports.type_of(kind) for field, kind in typing.get_type_hints(hint, include_extras=True).items()}
    outputs = {}
    for port, value in returned.items():
        if isinstance(value, Output) or port not in kinds:
            outputs.update(_outputs({port: value}))
        else:
            outputs[port] = {"type": kinds[port], "value": entry(value)}
    return outputs


@dataclass(frozen=True)
class Doc:
    """What a parameter is, for people: ``boxes: Annotated[int, ratn.Doc("how many")] = 3``."""

    text: str


def _parameters(function: Callable[..., Any], hints: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Value]]:
    parameters: dict[str, Any] = {}
    given: dict[str, Value] = {}
    place = _ports.where(function)
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD, parameter.POSITIONAL_ONLY):
            raise TypeError(f"{place}: `{parameter}` is no parameter of a task: it has a name and a type")
        hint, has_default = hints.get(parameter.name), parameter.default is not parameter.empty
        given[parameter.name] = Value(f"${parameter.name}")
        if hint is None and has_default:
            parameters[parameter.name] = entry(parameter.default)
            continue
        try:
            said: dict[str, Any] = {"type": "any" if hint is None else _ports.type_of(hint)}
        except TypeError as wrong:
            raise TypeError(f"{place}: parameter `{parameter.name}`: {wrong}") from None
        if has_default:
            default = parameter.default
            said["default"] = entry(default if isinstance(default, Value) else _ports.fitting(default, said["type"]))
        for about in getattr(hint, "__metadata__", ()):
            if isinstance(about, Doc):
                said["description"] = about.text
        parameters[parameter.name] = said
    return parameters, given


__all__ = ["Untraceable"]
