"""Tasks in plain sequential Python, traced once into the same model as a task file.

``@ratn.task`` calls the function once, with its parameters as values that are known only while the task runs. Each call of an action adds a
state, each ``with`` block and each ``ratn.each`` a state with states inside. What comes out is the tree of a task file; what it means,
and what is wrong with it, is decided by the same code as for YAML.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import pathlib
import tempfile
import types
import typing
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NoReturn

from ratn import _ports, _ratn, _resources, _source, _yaml
from ratn._annotations import VALUES, Output, entry, outputs_said, raw
from ratn._expression import Binding, Untraceable, Value, Variable, literal, refuse, user_frame
from ratn._identity import refuse_identity
from ratn._ratn import Error, InvalidTask
from ratn._step import kind_of
from ratn._trace import Trace, tracing
from ratn._yaml import Body


@dataclass(frozen=True)
class Finding:
    """A problem of a task, with the line of the file that causes it."""

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
    """A task: the tree of a task file, traced from a Python function or read from YAML."""

    def __init__(
        self,
        document: dict[str, Any],
        *,
        folder: pathlib.Path,
        file: str,
        catalogues: Iterable[str] = (),
        steps: dict[str, Any] | None = None,
        source: str | None = None,
        is_traced: bool = False,
    ) -> None:
        #: The tree, as dicts and lists.
        self.document = document
        #: The folder to which the paths of libraries and the ontology are relative.
        self.folder = folder
        self._file, self._catalogues, self._steps = file, list(catalogues), dict(steps or {})
        self._source, self._is_traced = source, is_traced

    @property
    def name(self) -> str:
        """The name of the task."""
        return str(self.document.get("task", ""))

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters, in the form of a task file."""
        return dict(self.document.get("parameters") or {})

    def __repr__(self) -> str:
        return f"<Task {self.name} of {self._file}>"

    def __call__(self, *_: object, **given: object) -> NoReturn:
        """A task is not callable any more: raises an error that says how to run it."""
        shown = ", ".join([self.name, *(f"{name}=…" for name in given)])
        raise TypeError(
            f"the task `{self.name}` is traced already and is not called: run it with `system.run({shown})`; in another task "
            f"perform it as a state of its own with `ratn.library(…)`, of its file (`{self.name}.to_yaml(\"{self.name}.yaml\")`)"
        )

    def _repr_markdown_(self) -> str:
        return f"```yaml\n{self.to_yaml()}```"

    @staticmethod
    def from_yaml(source: str | os.PathLike[str]) -> Task:
        """Reads a task file, or the text of a task file (a string with a line break)."""
        if isinstance(source, str) and "\n" in source:
            text, file, folder = source, "<text>", pathlib.Path.cwd()
        else:
            path = pathlib.Path(source)
            text, file, folder = path.read_text(encoding="utf-8"), str(path), path.resolve().parent
        document = _ratn.read_yaml(text, file)
        if not isinstance(document, dict):
            raise InvalidTask(f"{file}:1: a task file is a mapping: begin it with `task: name`")
        return Task(document, folder=folder, file=file, source=text)

    def to_yaml(self, path: str | os.PathLike[str] | None = None) -> str:
        """The text of an equivalent task file; also written to ``path``, if given.

        Comments and formatting are not kept. Paths in it stay relative to ``folder``, or to the folder of the file that was read.
        """
        text = "\n".join(_yaml.write(self.document).text) + "\n"
        if path is not None:
            pathlib.Path(path).write_text(text, encoding="utf-8")
        return text

    def to_python(self) -> str:
        """Python code from which the same task can be traced, to continue a task file in Python."""
        return _source.python_of(self.document)

    def _lines(self) -> _yaml.Lines:
        """The text of the task; it is the file's own text if the tree that was read has not been changed."""
        if self._source is not None and _ratn.read_yaml(self._source, self._file) == self.document:
            lines = _yaml.Lines()
            lines.text = self._source.splitlines()
            return lines
        return _yaml.write(self.document)

    def standing_alone(self) -> str:
        """The text of the task file with absolute paths."""
        return "\n".join(self._standing_alone().text) + "\n"

    def _step_files(self) -> dict[str, str]:
        """The files of its steps, by their provider in the task."""
        return {name.rpartition("/")[0]: step.file for name, step in self._steps.items()}

    def _with_providers(self, providers: dict[str, str]) -> Task:
        """The same task with other providers for its steps."""
        actions = {name: f"{providers[name.rpartition('/')[0]]}/{step.name}" for name, step in self._steps.items()}
        kinds = {kind_of(provider): kind_of(own) for provider, own in providers.items()}

        def renamed(body: dict[str, Any]) -> None:
            if isinstance(body.get("action"), str):
                body["action"] = actions.get(body["action"], body["action"])
            if isinstance(body.get("resources"), list):
                body["resources"] = [_of_kind(one, kinds) for one in body["resources"]]

        document = {**self.document, "states": _changed(self.document.get("states") or [], renamed)}
        steps = {actions[name]: step for name, step in self._steps.items()}
        return Task(document, folder=self.folder, file=self._file, catalogues=self._catalogues, steps=steps)

    def _knowing(self, offered: Callable[[], _resources.Offers] | None = None) -> Task:
        """The same task, in which states without resources block the providers of their actions. `offered` returns the actions of a system; it is called
        if an action is in no catalogue. A task from a file already has all its resources."""
        if not self._is_traced:
            return self
        known = _resources.of_catalogues(*self._all_catalogues())
        asked: list[_resources.Offers] = []

        def offer(action: str) -> dict[str, Any] | None:
            if action in known or offered is None:
                return known.get(action)
            if not asked:
                asked.append(offered())
            if action not in asked[0]:
                raise Error(
                    f"nobody in the system offers the action `{action}`, and so nobody knows what performs it: say `resources=[\"Kind\"]` at it, or see `ratn actions`"
                )
            return asked[0][action]

        # Makes a copy.
        states = _changed(self.document.get("states") or [], lambda _: None)
        _resources.block_what_performs(states, offer)
        return Task({**self.document, "states": states}, folder=self.folder, file=self._file, catalogues=self._catalogues, steps=self._steps)

    def _standing_alone(self) -> _yaml.Lines:
        document = dict(self.document)
        if isinstance(document.get("ontology"), str):
            document["ontology"] = str(self.folder / document["ontology"])

        def rooted(body: dict[str, Any]) -> None:
            if isinstance(body.get("library"), str):
                body["library"] = str(self.folder / body["library"])

        document["states"] = _changed(document.get("states") or [], rooted)
        return _yaml.write(document)

    def _all_catalogues(self) -> list[str]:
        return [*self._catalogues, *(step.catalogue(name.rpartition("/")[0]) for name, step in self._steps.items())]

    def _read(self) -> tuple[list[Finding], dict[str, Any] | None]:
        lines = self._knowing()._lines()
        catalogues = self._all_catalogues()
        said, model = _ratn.check_task("\n".join(lines.text) + "\n", str(self.folder / pathlib.Path(self._file).name), catalogues)
        findings = [self._finding(one, lines) for one, _ in json.loads(said)]
        return findings, None if model is None else json.loads(model)

    def _finding(self, said: dict[str, Any], lines: _yaml.Lines, name: str | None = None) -> Finding:
        file, line = said["file"], said["location"]["line"]
        if pathlib.Path(file).name == (name or pathlib.Path(self._file).name):
            file, line = lines.origin(line) or (self._file, line)
        return Finding(said["rule"], said["severity"], file, line, said["path"], said["message"], said["help"])

    def check(self, *, system: object = None, config: str | os.PathLike[str] | None = None) -> list[Finding]:
        """The findings of ``ratn check``, with lines of the Python file; an invalid task raises ``ratn.InvalidTask``.

        It is checked against the built-in catalogue, the catalogues of the action modules that it uses, and its own steps; with a ``system`` (a
        ``ratn.System``, or a runtime directory) against the catalogue of that system and the descriptions of its workers; with a ``config`` against
        the catalogue of the config.
        """
        if system is not None or config is not None:
            return self._check_with(system, config)
        findings, model = self._read()
        if model is None:
            raise invalid(findings)
        return findings

    def _check_with(self, system: object, config: str | os.PathLike[str] | None) -> list[Finding]:
        """Checks as ``ratn check`` does, with knowledge of a system."""
        from ratn._system import _told

        runtime_dir = getattr(system, "runtime_dir", system)
        lines = self._knowing(lambda: _resources.of_system(runtime_dir, config))._standing_alone()
        with tempfile.TemporaryDirectory(prefix="ratn-check-") as folder:
            file = pathlib.Path(folder) / pathlib.Path(self._file).with_suffix(".yaml").name
            file.write_text("\n".join(lines.text) + "\n", encoding="utf-8")
            command = ["check", str(file), "--no-simulation", "--json"]
            for number, catalogue in enumerate(self._all_catalogues()):
                (pathlib.Path(folder) / f"{number}.toml").write_text(catalogue, encoding="utf-8")
                command += ["--catalogue", str(pathlib.Path(folder) / f"{number}.toml")]
            command += ["--config", os.fspath(config)] if config is not None else []
            command += ["--runtime-dir", str(runtime_dir)] if runtime_dir is not None else []
            told = _told(command)
        if not told.stdout.strip():
            raise Error(told.stderr.strip() or f"`ratn check` has ended with code {told.returncode}")
        said = json.loads(told.stdout)
        findings = [self._finding(one, lines, file.name) for one in said["findings"]]
        # The workers of steps come with the run.
        kinds = [f"`{kind_of(provider)}`" for provider in self._step_files()]
        workers = [what for what in said["workers"] if not any(kind in what for kind in kinds)]
        findings += [Finding("worker", "warning", self._file, 1, "", what, "") for what in workers]
        if said["task"] is None:
            raise invalid(findings)
        return findings

    def model(self) -> dict[str, Any]:
        """The model used by all parts of the system, as dicts and lists; two tasks are equivalent if their models are equal."""
        findings, model = self._read()
        if model is None:
            raise invalid(findings)
        model.pop("digest")
        for state in model["states"]:
            state.pop("location")
        return model


def _changed(value: Any, change: Callable[[dict[str, Any]], None]) -> Any:
    """Applies `change` to the definition of each state, at all depths."""
    if isinstance(value, list):
        return [_changed_state(item, change) for item in value]
    if not isinstance(value, dict):
        return value
    # Expressions, and values that contain some, name neither actions nor files.
    body = _like(value, {key: item if key in ("in", "with", *VALUES) else _changed(item, change) for key, item in value.items()})
    change(body)
    return body


def _changed_state(item: Any, change: Callable[[dict[str, Any]], None]) -> Any:
    """A changed entry of a list of states, whose name may be a word with another meaning in states."""
    name, body = _source.named(item) if isinstance(item, dict) else (None, item)
    return _changed(body, change) if name is None else _like(item, {name: _changed(body, change)})


def _like(before: dict[str, Any], entries: dict[str, Any]) -> dict[str, Any]:
    """A mapping that replaces another one and keeps its line."""
    if getattr(before, "line", None) is None:
        return entries
    body = Body(entries)
    body.line = before.line  # type: ignore[attr-defined]
    return body


def _of_kind(resource: Any, kinds: dict[str, str]) -> Any:
    """An entry of `resources` that replaces another one and keeps its kind."""
    if isinstance(resource, dict):
        return {key: kinds.get(kind, kind) if key in ("block", "consume") and isinstance(kind, str) else kind for key, kind in resource.items()}
    return kinds.get(resource, resource) if isinstance(resource, str) else resource


def invalid(findings: list[Finding]) -> InvalidTask:
    """The exception for findings, at least one of which refuses the task."""
    raised = InvalidTask("\n".join(map(str, findings)))
    raised.findings = findings
    return raised


@typing.overload
def task(function: Callable[..., Any], /) -> Task: ...
@typing.overload
def task(*, name: str | None = None, **said: Any) -> Callable[[Callable[..., Any]], Task]: ...
def task(
    function: Callable[..., Any] | None = None,
    *,
    name: str | None = None,
    **said: Any,
) -> Task | Callable[[Callable[..., Any]], Task]:
    """Makes a function a task: it is called once, immediately, and its calls become the task's states.

    Its parameters are the task's, typed by their annotations (a default makes a parameter optional); the returned dict has the task's outputs; the
    first paragraph of its docstring is the description. Keyword arguments are keys of a task file: ``horizon``, ``speculation_width``, ``deadline``,
    ``exceptions``, ``ontology``, ``tolerance``, ``world``, ``outcomes``, ``variables``, ``functions``, ``description``.
    """
    if function is None:
        return lambda function: _traced(function, name, said)
    return _traced(function, name, said)


_TASK_KEYS = ("description", "horizon", "speculation_width", "deadline", "exceptions", "ontology", "tolerance", "world", "outcomes", "variables", "functions")


def _traced(function: Callable[..., Any], name: str | None, said: dict[str, Any]) -> Task:
    if not isinstance(function, types.FunctionType):
        kind = "class" if isinstance(function, type) else type(function).__name__
        raise TypeError(f"`ratn.task` takes a function, and is given the {kind} `{getattr(function, '__name__', function)}`: write `@ratn.task` above a `def`")
    name, said = name or function.__name__, dict(said)
    unknown = [key for key in said if key not in _TASK_KEYS]
    if unknown:
        raise TypeError(f"`@ratn.task` has no `{unknown[0]}`; it has {', '.join(('name', *_TASK_KEYS))}")
    if tracing.get() is not None:
        refuse("a task within a task", "call a plain function, which is traced as if it stood here, or use `ratn.library(file)`")
    file = function.__code__.co_filename
    if inspect.iscoroutinefunction(function) or inspect.isgeneratorfunction(function):
        refuse("a task is a plain function", "write `def`, without `async` and `yield`", (file, function.__code__.co_firstlineno))
    trace = Trace(file)
    document = Body({"task": name})
    document.line = (file, function.__code__.co_firstlineno)
    description = said.pop("description", None) or (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ")
    if description:
        document["description"] = description
    # Annotations may be texts, and may name variables of the enclosing function.
    hints = typing.get_type_hints(function, localns={**user_frame().f_locals}, include_extras=True)
    parameters, given = _parameters(function, hints, trace)
    refuse_identity(function)
    token = tracing.set(trace)
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
        trace.check_leads()
        document["states"] = [node.item() for node in trace.top]
        _whole(document)
    finally:
        tracing.reset(token)
    path = pathlib.Path(file)
    folder = path.resolve().parent if path.exists() else pathlib.Path.cwd()
    return Task(document, folder=folder, file=file, catalogues=trace.catalogues, steps=trace.steps, is_traced=True)


def _whole(value: Any, at: tuple[str, int] | None = None) -> None:
    """Refuses a text with a value in it that is no expression, and a number that is not finite, at any place."""
    if isinstance(value, dict):
        at = getattr(value, "line", None) or at
        for key, item in value.items():
            _whole(key, at)
            _whole(item, at)
    elif isinstance(value, (list, tuple)):
        for item in value:
            _whole(item, at)
    elif isinstance(value, float) and not math.isfinite(value):
        refuse(f"{value} is no number of a task", "say a finite one; without a `timeout` nothing ends the wait", at)
    elif isinstance(value, str):
        literal(value)


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
            outputs.update(outputs_said({port: value}))
        else:
            outputs[port] = {"type": kinds[port], "value": entry(value)}
    return outputs


@dataclass(frozen=True)
class Doc:
    """The description of a parameter for people: ``boxes: Annotated[int, ratn.Doc("how many")] = 3``."""

    text: str


def _parameters(function: Callable[..., Any], hints: dict[str, Any], trace: Trace) -> tuple[dict[str, Any], dict[str, Value]]:
    parameters: dict[str, Any] = {}
    given: dict[str, Value] = {}
    place = _ports.where(function)
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD, parameter.POSITIONAL_ONLY):
            raise TypeError(f"{place}: `{parameter}` is no parameter of a task: it has a name and a type")
        hint, has_default = hints.get(parameter.name), parameter.default is not parameter.empty
        bound = Binding(parameter.name, "parameter", (function.__code__.co_filename, function.__code__.co_firstlineno))
        trace.bindings[parameter.name] = bound
        given[parameter.name] = Variable(bound)
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
