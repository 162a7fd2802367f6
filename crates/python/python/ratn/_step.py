"""Steps: functions of Python as states of a task. They run in a worker that lives as long as the run.

A step is an action of a worker, made of its function as ``Worker.action`` makes one. ``python -m ratn._step FILE PROVIDER`` is that worker: it runs the file in
which the steps stand (with another ``__name__`` than ``__main__``) and serves them.
"""

from __future__ import annotations

import inspect
import os
import pathlib
import runpy
import sys
import typing
from collections.abc import Callable, Iterable
from typing import Any

from ratn import _annotations, _expression, _ports, _states, _stubs, _trace, _worker
from ratn._ratn import Error, Goal

#: The steps of this process, by file and name.
_STEPS: dict[str, dict[str, Step]] = {}
#: The file from which a worker is reading its steps.
_being_read: str | None = None


def refuse_while_read(what: str) -> None:
    """Ends a program that would otherwise start itself again and again."""
    if _being_read is not None:
        raise Error(
            f"{_being_read} is being read by the worker of its steps, and {what}: write what the program does below `if __name__ == \"__main__\":`"
        )


def kind_of(provider: str) -> str:
    """The kind of resource of a provider of steps."""
    return "".join(part.capitalize() for part in provider.split("_"))


class Step:
    """A function as a state. In a task, a call adds the state; elsewhere it calls the function, without a goal if it takes none."""

    def __init__(self, function: Callable[..., Any], name: str | None, said: dict[str, Any]) -> None:
        self.function, self.said = function, said
        self.name = name or function.__name__
        self.file = os.path.abspath(function.__code__.co_filename)
        stem = "".join(letter if letter.isalnum() else "_" for letter in pathlib.Path(self.file).stem).lower().strip("_")
        #: The name of the provider in tasks, and the kind of its resource.
        self.provider = f"{stem or 'steps'}_steps"
        self.kind = kind_of(self.provider)
        parameters = list(inspect.signature(function).parameters)
        hints = typing.get_type_hints(function, include_extras=True)
        self.takes_goal = bool(parameters) and (hints.get(parameters[0]) is Goal or parameters[0] == "goal")
        of_file = _STEPS.setdefault(self.file, {})
        before = of_file.get(self.name)
        # A file may be read twice: by the worker, and by an import in one of its modules.
        if _being_read == self.file and before is not None and before.function.__code__.co_firstlineno != function.__code__.co_firstlineno:
            raise ValueError(f"{_ports.where(function)}: there is a step `{self.name}` in this file already")
        of_file[self.name] = self
        # A fault is refused here, with the line of the function.
        self.action = self._known_to(_worker.Worker(self.provider, kind=self.kind))

    def _known_to(self, worker: _worker.Worker) -> _ports.Action:
        function = self.function
        if not self.takes_goal:
            function = _without_goal(function)
        worker.action(name=self.name, **self.said)(function)
        return worker._actions[self.name]

    def __call__(self, *positional: Any, **given: Any) -> Any:
        trace = _trace.tracing.get()
        if trace is None:
            return self.function(*positional, **given)
        if not os.path.exists(self.file):
            _expression.refuse(f"the step `{self.name}` stands in no file", "its worker runs the file: write it into a module and import it")
        if positional:
            raise TypeError(f"the step `{self.name}` takes its inputs by name: `{self.name}(port=value)`")
        provider = trace.provider_of_steps(self.provider, self.file)
        trace.steps[f"{provider}/{self.name}"] = self
        ports = {port for port, *_ in self.action.inputs}
        name = given.pop("name", None) if "name" not in ports else None
        inputs = {key: given.pop(key) for key in list(given) if key in ports}
        for key in given:
            if key not in _annotations.ANNOTATIONS:
                raise TypeError(f"the step `{self.name}` has no input `{key}`; it has {', '.join(sorted(ports)) or 'none'}")
        # The step's annotations apply to the state, unless the state gives others.
        said = {"computes": self.action.computes or None, "reads": self.action.reads or ([] if self.action.computes else None)}
        said |= {key: getattr(self.action, key) or None for key in ("senses", "requires", "effects")}
        return _states.perform(f"{provider}/{self.name}", inputs, {**said, **given}, name=name, kind=kind_of(provider))

    def catalogue(self, provider: str) -> str:
        """The catalogue entry of this step for a provider."""
        ports: dict[str, dict[str, str]] = {"inputs": {}, "optional": {}, "outputs": dict(self.action.outputs)}
        for port, kind, is_required, _ in self.action.inputs:
            ports["inputs" if is_required else "optional"][port] = kind
        name = f"{provider}/{self.name}"
        return _stubs.toml([{"action": name, "resource": kind_of(provider), **ports, "outcomes": self.action.outcomes, "description": self.action.description}])


def _without_goal(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with an additional first parameter for the goal, as an action has it."""
    signature = inspect.signature(function)
    goal = inspect.Parameter("goal", inspect.Parameter.POSITIONAL_ONLY, annotation=Goal)
    if "goal" in signature.parameters:
        raise TypeError(f"{_ports.where(function)}: `goal` is the first parameter, or none")

    def called(goal: Goal, /, **given: Any) -> Any:
        return function(**given)

    called.__wrapped__ = function  # type: ignore[attr-defined]
    called.__signature__ = signature.replace(parameters=[goal, *signature.parameters.values()])  # type: ignore[attr-defined]
    called.__annotations__ = {"goal": Goal, **function.__annotations__}
    called.__name__, called.__doc__ = function.__name__, function.__doc__
    called.__code__ = called.__code__.replace(co_filename=function.__code__.co_filename, co_firstlineno=function.__code__.co_firstlineno)
    return called


@typing.overload
def step(function: Callable[..., Any], /) -> Step: ...
@typing.overload
def step(
    *,
    name: str | None = None,
    outputs: dict[str, Any] | None = None,
    outcomes: Iterable[str] = (),
    computes: bool | None = None,
    reads: Iterable[str] | None = None,
    senses: Iterable[str] = (),
    requires: Iterable[str] = (),
    effects: Iterable[str] | None = None,
) -> Callable[[Callable[..., Any]], Step]: ...
def step(
    function: Callable[..., Any] | None = None,
    *,
    name: str | None = None,
    outputs: dict[str, Any] | None = None,
    outcomes: Iterable[str] = (),
    computes: bool | None = None,
    reads: Iterable[str] | None = None,
    senses: Iterable[str] = (),
    requires: Iterable[str] = (),
    effects: Iterable[str] | None = None,
) -> Step | Callable[[Callable[..., Any]], Step]:
    """Makes a function a step: in a task, its call is a state that a worker of the run performs.

    Parameters are as in ``Worker.action``, but the goal may be omitted. A step that says nothing of ``computes``, ``reads``, ``senses`` and ``effects``
    may do anything, so it runs in its order. So may one with ``computes=False``, beyond what it says of ``reads`` and ``effects``. Any other one has no
    effects and reads no facts beyond what it says: ``reads=[]`` is enough for one that only computes, which runs ahead, also on ways that are not
    taken. The worker executes the step's file: code for the program that starts the run
    belongs below ``if __name__ == "__main__":``.
    """
    # The arguments may be iterators, and are needed twice: here, and by the worker.
    outcomes, senses, requires = list(outcomes), list(senses), list(requires)
    if senses or not (computes is None and reads is None and effects is None):
        reads, effects = list(reads or ()), list(effects or ())
        computes = not (senses or effects) if computes is None else computes
    said = {"outputs": outputs, "outcomes": outcomes, "computes": computes, "reads": reads, "senses": senses, "requires": requires, "effects": effects}
    return (lambda function: Step(function, name, said)) if function is None else Step(function, name, said)


def serve(file: str, provider: str, arguments: list[str]) -> None:
    """Serves the steps of a file under this provider name."""
    path = os.path.abspath(file)
    sys.path.insert(0, os.path.dirname(path))
    global _being_read
    _being_read = path
    try:
        runpy.run_path(path, run_name="__ratn_steps__")
    finally:
        _being_read = None
    steps = list(_STEPS.get(path, {}).values())
    if not steps:
        raise SystemExit(f"{file} has no steps: decorate a function with `@ratn.step`")
    worker = _worker.Worker(provider, kind=kind_of(provider))
    for one in steps:
        one._known_to(worker)
    worker.run(arguments)


if __name__ == "__main__":
    # The package's own module, not this one, whose name is `__main__`.
    from ratn import _step

    _step.serve(sys.argv[1], sys.argv[2], sys.argv[3:])
