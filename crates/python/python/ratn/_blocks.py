"""States that contain other states, as ``with`` blocks and loops."""

from __future__ import annotations

import ast
import itertools
from collections.abc import Iterable, Iterator
from typing import Any

from ratn._annotations import annotate, entry, output, outputs_said
from ratn._expression import Value, Variable, expression, literal, refuse, statements_at_work, user_line, words
from ratn._trace import AnyState, Node, Port, Trace, assigned_name, calls


class Block(AnyState):
    """A ``with`` block: a state that contains other states."""

    __slots__ = ("_branch", "_trace")
    _FORM: str = "states"
    #: The default name of the block; some kinds of blocks have one.
    _IMPLIED: str | None = None

    def __init__(self, function: str, name: str | None, annotations: dict[str, Any], head: dict[str, Any], default: str) -> None:
        at = user_line()
        trace = Trace.now(f"`ratn.{function}`")
        node = trace.add(name, default, at, assigned_name(function, at) or self._IMPLIED)
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
        """Sets a property of the block, inside it or after it."""
        is_open = {id(states) for states, _ in self._trace.open}
        lists = [(states, self._node) for branch, states in self._node.branches.items() if branch != "finally"]
        depth = len(self._trace.open)
        self._trace.open += [one for one in lists if id(one[0]) not in is_open]
        try:
            self._node.body.setdefault(key, {}).update(outputs_said(said) if key == "outputs" else entry(said))
        finally:
            del self._trace.open[depth:]

    def outputs(self, **outputs: Any) -> None:
        """Adds outputs of the block: ``think.outputs(way=plan.trajectory)``. Values that are used outside become outputs without that, too."""
        self._say("outputs", outputs)


class Ordered(Block):
    """A sequence of states, as one state."""

    __slots__ = ()


class Retry(Ordered):
    """A block with retries. A block of one action, without ``name=``, becomes that action with a ``retry``."""

    __slots__ = ("_is_named",)
    _is_named: bool

    def before(self) -> _Before:
        """The states before each further attempt: ``with attempt.before():``."""
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
        # This list is not inside the block with retries, and sees nothing of it.
        at = next((index for index, (_, owner) in enumerate(trace.open) if owner is node), len(trace.open))
        self._outside, trace.open[at:] = trace.open[at:], [(node.before, node)]

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._trace.open[-1:] = self._outside


class Condition(Block):
    """A condition: the states that run if it is true; :func:`otherwise` is the other branch."""

    __slots__ = ()
    _FORM = "then"


#: The variable that a loop binds in addition to its element.
_NUMBER = "number of the iteration"


class Loop(Block):
    """A loop."""

    __slots__ = ("_key", "_index")
    _FORM = "do"
    _key: str
    _index: str | None

    def test(self, condition: object) -> None:
        """The condition, set inside the loop: it may use the states of the loop."""
        self._node.body[self._key] = _condition(condition)

    @property
    def index(self) -> Value:
        """The number of the iteration, from 0."""
        if self._index is None:
            self._index = self._trace.free(self._node, "iteration")
            self._node.body["index"] = self._index
        return Variable(self._trace.bind(self._node, self._index, _NUMBER, self._node.line))

    def __exit__(self, kind: object, *exception: object) -> None:
        super().__exit__(kind, *exception)
        if kind is None and self._key not in self._node.body:
            refuse("a loop without a condition", "say it as `ratn.until(condition)`, or inside as `loop.test(condition)`", self._node.line)


class Concurrency(Block):
    """Concurrent regions: each state inside is one."""

    __slots__ = ()
    _FORM = "regions"
    _IMPLIED = "concurrently"

    def decide(self, **outcomes: Any) -> None:
        """Sets how the outcome is decided: the first one whose condition holds: ``both.decide(blind=head.outcome == "aborted")``."""
        self._say("decide", outcomes)


def sequence(name: str | None = None, **annotations: Any) -> Ordered:
    """A hierarchy: states in sequence as one state: ``with ratn.sequence("think", routine=True) as think:``."""
    return Ordered("sequence", name, annotations, {}, "sequence")


def retry(
    times: int | None = None, *, on: Iterable[str] | None = None, backoff: float | None = None, name: str | None = None, **annotations: Any
) -> Retry:
    """Repeats the block after a failure, at most ``times`` times after the first try: ``with ratn.retry(3):``.

    ``on`` are the outcomes that cause a repetition (default ``aborted``), ``backoff`` the pause before the second try, in seconds.
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
    return words(condition) if isinstance(condition, str) else entry(condition)


def when(condition: object, *, name: str | None = None, **annotations: Any) -> Condition:
    """Performs the block if the condition is true: ``with ratn.when(fn.len(look.boxes) > 0):``. A string is an expression."""
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
    """Performs the block if the condition of the previous ``ratn.when`` is not true."""
    return _Otherwise()


class _Lastly:
    def __init__(self) -> None:
        trace = Trace.now("`ratn.lastly`")
        siblings, _ = trace.open[-1]
        if not siblings or "finally" in siblings[-1].branches:
            refuse("`ratn.lastly` without a state", "write it right behind the state or block that it is about")
        self._trace, self._node = trace, siblings[-1]

    def __enter__(self) -> None:
        self._trace.enter(self._node, "finally")

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._trace.leave(self._node)


def lastly() -> _Lastly:
    """Performs the block on every way out of the state or block before it: ``finally`` in a task file."""
    return _Lastly()


class Each(Iterator[Any]):
    """A loop over a list; its body is traced once."""

    def __init__(self, elements: object, variable: str | None, index: str | bool | None, name: str | None, annotations: dict[str, Any]) -> None:
        at = user_line()
        self._trace = Trace.now("`ratn.each`")
        targets = self._targets(at)
        if index is True:
            self._index: str | None = targets[0] if len(targets) == 2 else self._trace.free(None, "index")
        else:
            self._index = index or None
        if variable is None and not targets and statements_at_work(*at):
            refuse("`ratn.each` outside of a `for`", "write `for x in ratn.each(list):`; of a list of values make another with `fn.map(list, lambda x: …)`", at)
        self._variable = variable or (targets[-1] if targets else self._trace.free(None, "element"))
        node = self._trace.add(name, f"for_{self._variable}", at)
        text = words(elements) if isinstance(elements, str) else expression(elements)
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
            if isinstance(node, ast.For) and calls(node.iter, "each"):
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
        trace, node = self._trace, self._node
        element = Variable(trace.bind(node, self._variable, "element of the loop", node.line))
        number = None if self._index is None else Variable(trace.bind(node, self._index, _NUMBER, node.line))
        return (number, element) if self._gives_index else element


def each(elements: object, *, variable: str | None = None, index: str | bool | None = None, name: str | None = None, **annotations: Any) -> Each:
    """Iterates over a list that is known only while the task runs: ``for box in ratn.each(look.boxes):``.

    With ``index=True`` also yields the indices: ``for i, box in ratn.each(look.boxes, index=True):``.
    """
    return Each(elements, variable, index, name, annotations)


def collect(value: object, *, name: str | None = None, type: str | None = None) -> Value:
    """Inside of a loop: the list of the value's results at the end of each iteration, for use after the loop: ``seen = ratn.collect(look.boxes)``."""
    at = user_line()
    trace = Trace.now("`ratn.collect`")
    place = trace.collects()
    name = literal(name, "a name") if name else assigned_name("collect", at) or "all"
    innermost, trace.open[place + 1 :] = trace.open[place + 1 :], []
    try:
        said = output(each=value, type=type).entry()
    finally:
        trace.open += innermost
    loop = trace.open[place][1]
    assert loop is not None
    outputs = loop.body.setdefault("outputs", {})
    free = next(n for n in itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2))) if n not in outputs or outputs[n] == said)
    outputs[free] = said
    return Value(Port(loop, free))


def _loop(key: str, function: str, condition: object, index: str | None, name: str | None, annotations: dict[str, Any]) -> Loop:
    head = {} if condition is None else {key: _condition(condition)}
    loop = Loop(function, name, annotations, {**head, **({"index": index} if index else {})}, function.rstrip("_"))
    loop._key, loop._index = key, index
    if index is not None:
        loop._trace.bind(loop._node, index, _NUMBER, loop._node.line)
    return loop


def while_(condition: object, *, index: str | None = None, name: str | None = None, **annotations: Any) -> Loop:
    """Repeats the block while the condition is true, which is checked before each iteration: ``with ratn.while_(tries < 3) as loop:``."""
    return _loop("while", "while_", condition, index, name, annotations)


def do_while(condition: object = None, *, index: str | None = None, name: str | None = None, **annotations: Any) -> Loop:
    """Like :func:`while_`, but the condition is checked after each iteration."""
    return _loop("do_while", "do_while", condition, index, name, annotations)


def until(condition: object = None, *, index: str | None = None, name: str | None = None, **annotations: Any) -> Loop:
    """Repeats the block until the condition is true, which is checked after each iteration."""
    return _loop("until", "until", condition, index, name, annotations)


def concurrently(kind: str | int = "barrier", *, name: str | None = None, **annotations: Any) -> Concurrency:
    """Concurrent regions: each state inside is one. ``barrier`` waits for all, ``preemptive`` ends with the first, a number when that many have succeeded."""
    return Concurrency("concurrently", name, annotations, {"concurrency": kind}, "concurrently")
