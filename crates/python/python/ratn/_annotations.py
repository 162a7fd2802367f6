"""Annotations of states: keyword arguments in Python, keys in a task file."""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ratn import _source
from ratn._expression import Value, expression, key_of, plain, words
from ratn._trace import State, Trace


class Annotations(typing.TypedDict, total=False):
    """The annotations of a state that performs an action, as keyword arguments: the keys of a task file."""

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


#: Annotation keys of a state, as keyword arguments.
ANNOTATIONS = (
    *(key for key in Annotations.__annotations__ if key not in ("name", "inputs")),
    "outcomes", "variables", "outputs", "routine", "decide",
)
#: Annotations that are expressions, or contain some: a Python text there is a string value, and not an expression.
VALUES = {"duration", "variables", "assign", "outputs", "decide"}

_KEYS = {name: key for key, name in _source.RENAMED.items()}

def entry(value: object) -> Any:
    """A Python value at a place where a task file has an expression."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, (int, float)) and not hasattr(value, "tolist"):
        return int(value) if isinstance(value, int) else float(value)
    if isinstance(value, dict):
        return {key_of(name): entry(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [entry(item) for item in value]
    return expression(value)


def raw(value: object) -> Any:
    """A value at a place where a task file has plain words: texts as they are, values as their expressions, states as their names."""
    if isinstance(value, State):
        return Trace.now("a state in `transitions`").leads_to(value._node)
    if isinstance(value, Value):
        return plain(value)
    if isinstance(value, dict):
        return {str(raw(name)): raw(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [raw(item) for item in value]
    if isinstance(value, str):
        return words(value)
    if value is None or isinstance(value, (bool, int, float)):
        return value
    return expression(value)


def annotate(body: dict[str, Any], said: dict[str, Any]) -> None:
    """Adds annotations from keyword arguments."""
    for key, value in said.items():
        if key not in ANNOTATIONS:
            known = ", ".join(ANNOTATIONS)
            raise TypeError(f"there is no annotation `{key}`; there are {known}")
        if value is None:
            continue
        key = _KEYS.get(key, key)
        if key in VALUES:
            body[key] = outputs_said(value) if key == "outputs" else entry(value)
        elif key == "resources" or isinstance(value, (list, tuple, set, frozenset)):
            body[key] = [raw(item) for item in (value if isinstance(value, (list, tuple, set, frozenset)) else [value])]
        else:
            body[key] = raw(value)


def outputs_said(outputs: dict[str, Any]) -> dict[str, Any]:
    return {name: value.entry() if isinstance(value, Output) else entry(value) for name, value in outputs.items()}


@dataclass
class Output:
    """An output with a type, and with a default for the case that it was not written: ``ratn.output(n, type="int")``."""

    value: object
    type: str | None = None
    default: object = None
    has_default: bool = False
    description: str | None = None
    is_of_each: bool = False

    def entry(self) -> dict[str, Any]:
        said: dict[str, Any] = {"each" if self.is_of_each else "value": entry(self.value)}
        if self.type is not None:
            said["type"] = self.type
        if self.has_default:
            said["default"] = entry(self.default)
        if self.description is not None:
            said["description"] = self.description
        return said


_NOTHING = object()


def output(
    value: object = _NOTHING, *, each: object = _NOTHING, type: str | None = None, default: object = _NOTHING, description: str | None = None
) -> Output:
    """An output of a task or block with a type, a default or a description. For a loop, ``each=`` gives the list of a value's results, one per iteration."""
    if (value is _NOTHING) == (each is _NOTHING):
        raise TypeError("an output has a value, or of a loop `each=`")
    is_of_each = value is _NOTHING
    said = each if is_of_each else value
    return Output(said, type, None if default is _NOTHING else default, default is not _NOTHING, description, is_of_each)


def block(kind: str, **said: Any) -> dict[str, Any]:
    """Blocks a resource exclusively while the state runs: ``ratn.block("Arm", count=1, where={"tool": "welder"})``."""
    return {"block": kind, **said}


def consume(kind: str, **said: Any) -> dict[str, Any]:
    """Consumes a resource for the rest of the run: ``ratn.consume("Battery", count=0.2)``."""
    return {"consume": kind, **said}


def create(kind: str, **said: Any) -> dict[str, Any]:
    """A resource of the task that is created when the state is committed."""
    return {"create": kind, "class": "task", **said}


def delete(kind: str, **said: Any) -> dict[str, Any]:
    """A resource of the task that is deleted when the state is committed."""
    return {"delete": kind, **said}
