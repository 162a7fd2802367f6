"""The ports of an action, read from the annotations of its function.

| annotation | type of the port |
|---|---|
| ``bool int float str bytes`` | ``bool int float string bytes`` |
| ``ratn.Pose ratn.Joints ratn.Trajectory`` | ``pose joints trajectory`` |
| ``list[T]``, ``dict[str, T]`` | ``list<T>``, ``map<T>`` |
| a ``TypedDict`` | a record with these fields |
| ``numpy.ndarray`` | ``list<float>``, given as an array; ``Annotated[numpy.ndarray, "bytes"]`` is one of bytes |
| ``Annotated[T, "joints"]`` | what the text says |
| ``T | None`` with the default ``None`` | that of ``T``; a goal may leave it out |
| ``typing.Any``, none | ``any`` |
"""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ratn._ratn import Goal, Joints, Pose, Trajectory

_SIMPLE = {
    bool: "bool",
    int: "int",
    float: "float",
    str: "string",
    bytes: "bytes",
    Pose: "pose",
    Joints: "joints",
    Trajectory: "trajectory",
    Any: "any",
    list: "list<any>",
    dict: "map<any>",
    inspect.Parameter.empty: "any",
}


@dataclass
class Action:
    """An action in the form that the native part takes."""

    name: str
    description: str
    inputs: list[tuple[str, str, bool, Any]]
    outputs: list[tuple[str, str]]
    outcomes: list[str]
    computes: bool
    reads: list[str] | None
    senses: list[str]
    requires: list[str]
    effects: list[str] | None
    blocks: list[str]
    takes: str | None
    perform: Callable[..., tuple[str, dict[str, Any], str]]
    suspends: bool = False
    anytime: bool = False
    arrays: set[str] = field(default_factory=set)


def where(function: Callable[..., Any]) -> str:
    """The file and line of a function, for messages."""
    code = function.__code__
    return f"{code.co_filename}:{code.co_firstlineno}: {function.__name__}"


def is_array(annotation: Any) -> bool:
    """Whether a type means numpy arrays; does not import numpy."""
    numpy = sys.modules.get("numpy")
    origin = typing.get_origin(annotation) or annotation
    if origin is typing.Annotated or hasattr(annotation, "__metadata__"):
        return is_array(typing.get_args(annotation)[0])
    if origin in (typing.Union, types.UnionType):
        present = [kind for kind in typing.get_args(annotation) if kind is not type(None)]
        return len(present) == 1 and is_array(present[0])
    return numpy is not None and isinstance(origin, type) and issubclass(origin, numpy.ndarray)


def type_of(annotation: Any) -> str:
    """The type of a port, in the grammar of task files."""
    if isinstance(annotation, typing.Hashable) and annotation in _SIMPLE:
        return _SIMPLE[annotation]
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated or hasattr(annotation, "__metadata__"):
        for said in annotation.__metadata__:
            if isinstance(said, str):
                return said
        return type_of(annotation.__origin__)
    if is_array(annotation):
        return "list<float>"
    if origin is list and arguments:
        return f"list<{type_of(arguments[0])}>"
    if origin is dict and len(arguments) == 2 and arguments[0] is str:
        return f"map<{type_of(arguments[1])}>"
    if typing.is_typeddict(annotation):
        fields = typing.get_type_hints(annotation)
        return "{" + ", ".join(f"{name}: {type_of(kind)}" for name, kind in fields.items()) + "}"
    if origin in (typing.Union, types.UnionType):
        present = [kind for kind in arguments if kind is not type(None)]
        if len(present) == 1:
            return type_of(present[0])
    raise TypeError(
        f"{annotation!r} is no type of a port: expected bool, int, float, str, bytes, ratn.Pose, ratn.Joints, "
        'ratn.Trajectory, list[…], dict[str, …], a TypedDict, numpy.ndarray, typing.Any or Annotated[…, "type"]'
    )


def inputs_of(function: Callable[..., Any]) -> tuple[list[tuple[str, str, bool, Any]], set[str]]:
    """The inputs: all parameters but the first, which is the goal; and the names of those that are passed as arrays."""
    place = where(function)
    hints = typing.get_type_hints(function, include_extras=True)
    parameters = list(inspect.signature(function).parameters.values())
    if not parameters or hints.get(parameters[0].name, Goal) is not Goal:
        raise TypeError(f"{place}: the first parameter of an action is its goal: `def {function.__name__}(goal: ratn.Goal, …)`")
    inputs, arrays = [], set()
    for parameter in parameters[1:]:
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD, parameter.POSITIONAL_ONLY):
            raise TypeError(f"{place}: `{parameter}` is no port: an input has a name and a type")
        annotation = hints.get(parameter.name, inspect.Parameter.empty)
        try:
            kind = type_of(annotation)
        except TypeError as wrong:
            raise TypeError(f"{place}: parameter `{parameter.name}`: {wrong}") from None
        if is_array(annotation):
            arrays.add(parameter.name)
        is_required = parameter.default is parameter.empty
        inputs.append((parameter.name, kind, is_required, None if is_required else parameter.default))
    return inputs, arrays


def outputs_of(function: Callable[..., Any], said: dict[str, Any] | None) -> list[tuple[str, str]]:
    """The outputs: as declared, else the fields of the returned ``TypedDict``, else the names in the function's ``return {…}``."""
    if said is not None:
        return [(name, kind if isinstance(kind, str) else type_of(kind)) for name, kind in said.items()]
    returned = typing.get_type_hints(function, include_extras=True).get("return")
    if typing.is_typeddict(returned):
        fields = typing.get_type_hints(returned, include_extras=True)
        return [(name, type_of(kind)) for name, kind in fields.items()]
    if returned is type(None):
        return []
    return [(name, "any") for name in _returned_names(function)]


def _returned_names(function: Callable[..., Any]) -> list[str]:
    help_ = (
        f"{where(function)}: its outputs are not known: return a `dict` display (`return {{\"object\": …}}`), annotate a TypedDict, "
        "or say `outputs={\"object\": str}`"
    )
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, SyntaxError):
        raise TypeError(help_) from None
    found: list[str] | None = None
    for node in _own_nodes(tree.body[0]):
        if not isinstance(node, ast.Return) or node.value is None:
            continue
        if isinstance(node.value, ast.Constant) and node.value.value is None:
            continue
        if isinstance(node.value, ast.Call) and "Outcome" in ast.dump(node.value.func):
            continue
        if not isinstance(node.value, ast.Dict):
            raise TypeError(help_)
        names = [key.value for key in node.value.keys if isinstance(key, ast.Constant) and isinstance(key.value, str)]
        if len(names) != len(node.value.keys) or (found is not None and sorted(found) != sorted(names)):
            raise TypeError(help_)
        found = names
    return found or []


def _own_nodes(function: ast.AST) -> typing.Iterator[ast.AST]:
    """The syntax nodes of a function, without those of functions inside it."""
    waiting = list(ast.iter_child_nodes(function))
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)):
            waiting.extend(ast.iter_child_nodes(node))


def fitting(value: Any, kind: str) -> Any:
    """An output converted to its port's type: numbers to joints, an array to bytes."""
    if kind == "joints" and not isinstance(value, Joints) and hasattr(value, "__len__"):
        return Joints(value)
    if kind == "bytes" and hasattr(value, "tobytes"):
        return value.tobytes()
    return value
