"""States without inner states, as functions: actions, waits, libraries, expression functions, variables."""

from __future__ import annotations

import inspect
import json
import os
import pathlib
from collections.abc import Callable, Iterable
from typing import Any

from ratn._annotations import ANNOTATIONS, annotate, entry
from ratn._expression import Binding, TaskFunctionScope, Value, Variable, binding, call, expression, literal, plain, refuse, user_line, words
from ratn._resources import resources
from ratn._trace import AnyState, State, Trace, assigned_name


def perform(
    action: str, inputs: dict[str, Any], annotations: dict[str, Any], *, name: str | None = None, kind: str | None = None
) -> AnyState:
    """Adds a state that performs ``provider/action``. Unless resources are given, it blocks one of ``kind``, the kind of the provider."""
    at = user_line()
    trace = Trace.now(f"`{action}`")
    function = action.rpartition("/")[2]
    node = trace.add(name, function, at, assigned_name(function, at) or function)
    node.body["action"] = action
    if inputs:
        node.body["in"] = {port: entry(value) for port, value in inputs.items()}
    annotate(node.body, annotations)
    if kind is not None and "resources" not in annotations:
        node.body["resources"] = resources(kind, node.body)
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
            # If a port has the name of an annotation, the port can be given only by `inputs={…}`.
            if key not in ANNOTATIONS:
                if key not in ports:
                    known = ", ".join(sorted(ports)) or "none"
                    raise TypeError(f"`{self._name}.{action}` has no input `{key}`; it has {known}. Annotations are {', '.join(ANNOTATIONS)}")
                inputs[key] = said.pop(key)
        # Resources from the catalogue apply if the state gives none.
        kind = None if signature.get("annotations", {}).get("resources") else self._provider["resource"]
        return perform(f"{self._name}/{action}", inputs, said, name=name, kind=kind)


def action(name: str, /, inputs: dict[str, Any] | None = None, **annotations: Any) -> AnyState:
    """A state that performs an action given by name: ``ratn.action("arm/follow", {"trajectory": plan.trajectory}, pia=True)``.

    Without ``resources`` it blocks its provider: a run, and ``task.check(system=…)``, ask the system about actions that are in no catalogue. In a
    task file (``task.to_yaml()``) such actions need ``resources``.
    """
    state_name = annotations.pop("name", None)
    return perform(name, inputs or {}, annotations, name=state_name)


def library(file: str | os.PathLike[str], *, name: str | None = None, **given: Any) -> AnyState:
    """Another task file as a state; keyword arguments that are not annotations are its parameters: ``ratn.library("fetch_boxes.yaml", boxes=2)``."""
    at = user_line()
    trace = Trace.now("`ratn.library`")
    node = trace.add(name, "library", at, assigned_name("library", at) or pathlib.Path(file).stem)
    node.body["library"] = literal(os.fspath(file), "a path")
    parameters = {**given.pop("parameters", {}), **{key: given.pop(key) for key in list(given) if key not in ANNOTATIONS}}
    if parameters:
        node.body["with"] = {key: entry(value) for key, value in parameters.items()}
    annotate(node.body, given)
    return AnyState(node)


def leave(outcome: str, *, name: str | None = None) -> State:
    """Leaves the enclosing block with one of its outcomes."""
    trace = Trace.now("`ratn.leave`")
    node = trace.add(name, "leave", None, f"leave_{literal(outcome, 'an outcome')}")
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
    """Waits for a condition on the world, for a time, or for a signal; no resources are held meanwhile.

    ``ratn.wait(ratn.fact("open", "lid"), timeout=60)``, ``ratn.wait(seconds=0.5)``, ``ratn.wait(until=30)`` (seconds since the run began), and
    ``order = ratn.wait(signal="order")``, where ``order.value`` is the value sent by ``run.signal("order", 2)``. After ``timeout`` seconds the
    outcome is ``timeout``.
    """
    given = {"for": condition, "seconds": seconds, "until": until, "signal": signal}
    said = {key: value for key, value in given.items() if value is not None}
    if len(said) != 1:
        refuse("a state waits for one thing", "say a condition, `seconds=`, `until=` or `signal=`")
    ((key, value),) = said.items()
    body = {key: entry(value) if not isinstance(value, str) else literal(value, "a signal") if key == "signal" else words(value)}
    if timeout is not None:
        body["timeout"] = timeout
    return _own("wait", name, f"wait_{'condition' if key == 'for' else key}", body, annotations)


def ask(
    question: object, choices: Iterable[str], *, default: str | None = None, timeout: float | None = None, name: str | None = None, **annotations: Any
) -> AnyState:
    """Asks the operator, who answers with ``ratn answer`` or ``run.answer("now")``: ``go_on = ratn.ask("May the arm move?", ["now", "never"])``.

    ``go_on.answer`` is the choice. A choice that is a key of ``transitions`` is an outcome. After ``timeout`` seconds the answer is ``default``;
    without a default the outcome is ``timeout``.
    """
    text = plain(question) if isinstance(question, Value) else literal(str(question), "a question")
    if isinstance(question, Value) and not text.startswith(("'", '"', "$", "concat(")):
        text = f"concat({text})"
    elif not isinstance(question, Value) and text.startswith(("'", '"', "$", "concat(")):
        # As a text literal, and not as an expression.
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
    node = trace.add(name, default, at, assigned_name(function, at) or default)
    node.body[function] = body
    annotate(node.body, annotations)
    return AnyState(node)


class TaskFunction:
    """An expression function of a task: see :func:`function`."""

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
                at = (self._function.__code__.co_filename, self._function.__code__.co_firstlineno)
                own = [Binding(parameter, "parameter", at) for parameter in self._parameters]
                with binding(TaskFunctionScope(self._name), *own):
                    body = expression(self._function(*map(Variable, own)))
            finally:
                self._is_traced = False
            head = f"{self._name}({', '.join(f'${parameter}' for parameter in self._parameters)})"
            trace.functions[self._name] = (self, head, body)
        return call(self._name, *arguments)


def function(function: Callable[..., Any]) -> TaskFunction:
    """Makes a function of the task file: written once, used in expressions, ``near(box.pose, table)``. It can use its parameters and facts only."""
    from ratn._identity import refuse_identity

    refuse_identity(function)
    return TaskFunction(function)


def variable(value: object, *, name: str | None = None) -> Variable:
    """A scoped variable of the enclosing task or block: ``tries = ratn.variable(0)``. States change it with ``assign``."""
    at = user_line()
    trace = Trace.now("`ratn.variable`")
    called = name or assigned_name("variable", at)
    if called is None:
        refuse("a variable has a name", "write `tries = ratn.variable(0)`, or `ratn.variable(0, name=\"tries\")`")
    owner = trace.open[-1][1]
    if owner is not None and "states" not in owner.branches:
        refuse("variables belong to the task or to a `ratn.sequence`", "say it before the block, or in a `with ratn.sequence():` inside of it")
    begins = entry(value)
    bound = trace.declare(owner, literal(called, "a name"), at)
    variables = trace.variables if owner is None else owner.body.setdefault("variables", {})
    variables[called] = begins
    return Variable(bound)
