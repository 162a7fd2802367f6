"""A worker: a process that performs actions, which are Python functions."""

from __future__ import annotations

import builtins
import contextvars
import inspect
import logging
import os
import pathlib
import sys
import typing
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, NoReturn, TypeVar

from ratn import _ports, _ratn
from ratn._ratn import Aborted, Cancelled, Goal, Lost, Numbers

_Function = TypeVar("_Function", bound=Callable[..., Any])


@dataclass
class Outcome:
    """The result of a goal that does not end with success: one of the action's ``outcomes``."""

    name: str
    outputs: dict[str, Any] = field(default_factory=dict)
    reason: str = ""


class Worker:
    """A worker, which performs one goal at a time. The template sets how many processes of it run in parallel.

    ``provider`` is its name in tasks (``inspector`` in ``inspector/nearest``); default: the name of its file. ``kind`` is the kind of its resource;
    default: the one of the template (``--kind``), or ``Inspector`` for ``inspector``.
    """

    def __init__(self, provider: str | None = None, *, kind: str | None = None) -> None:
        self.provider = provider or _name_of_script()
        self.kind = kind
        self._actions: dict[str, _ports.Action] = {}

    @typing.overload
    def action(self, function: _Function, /) -> _Function: ...
    @typing.overload
    def action(
        self,
        *,
        name: str | None = None,
        outputs: dict[str, Any] | None = None,
        outcomes: Iterable[str] = (),
        computes: bool | None = None,
        reads: Iterable[str] | None = None,
        senses: Iterable[str] = (),
        requires: Iterable[str] = (),
        effects: Iterable[str] | None = None,
        blocks: Iterable[str] = (),
        takes: float | str | None = None,
        suspends: bool = False,
        anytime: bool = False,
    ) -> Callable[[_Function], _Function]: ...
    def action(
        self,
        function: _Function | None = None,
        *,
        name: str | None = None,
        outputs: dict[str, Any] | None = None,
        outcomes: Iterable[str] = (),
        computes: bool | None = None,
        reads: Iterable[str] | None = None,
        senses: Iterable[str] = (),
        requires: Iterable[str] = (),
        effects: Iterable[str] | None = None,
        blocks: Iterable[str] = (),
        takes: float | str | None = None,
        suspends: bool = False,
        anytime: bool = False,
    ) -> Any:
        """Makes a function (also an ``async def``) an action. Its first parameter is the goal, the others are the input ports.

        It returns its outputs as a ``dict``, or an ``Outcome``. ``computes`` means that it neither acts nor senses; default: true if it declares no
        effects (``effects=[]``) and senses nothing. An action without any declaration may move something. The other arguments are the default
        annotations of its states, in the syntax of task files (``$start`` is the state's input): the facts that it ``reads``, its ``effects``
        (``[]``: none; omitted: unknown, so any), what it ``senses`` and ``requires``, the kinds of resources that it ``blocks`` besides its own, and
        how many seconds it usually ``takes``. An action that ``suspends`` stands still while its goal is suspended because the resource manager
        cannot be reached (``goal.while_held()`` between its steps); the others end then. An ``anytime`` action computes or senses, and gives
        intermediate results (``goal.improved``) if its goal allows this (``goal.improves``); each of them is good enough.
        """

        def known(function: _Function) -> _Function:
            if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function):
                raise TypeError(f"{_ports.where(function)}: an action returns its outputs once, without `yield`; `goal.progress` tells how far it is")
            senses_, effects_ = list(senses), None if effects is None else list(effects)
            inputs, arrays = _ports.inputs_of(function)
            action = _ports.Action(
                name=name or function.__name__,
                description=(inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " "),
                inputs=inputs,
                outputs=_ports.outputs_of(function, outputs),
                outcomes=list(outcomes),
                computes=not senses_ and effects_ == [] if computes is None else computes,
                reads=None if reads is None else list(reads),
                senses=senses_,
                requires=list(requires),
                effects=effects_,
                blocks=list(blocks),
                takes=None if takes is None else str(takes),
                suspends=suspends,
                anytime=anytime,
                perform=lambda *_: ("aborted", {}, "not ready"),
                arrays=arrays,
            )
            if action.name in self._actions:
                raise ValueError(f"{_ports.where(function)}: there is an action `{action.name}` already")
            if inspect.iscoroutinefunction(function):
                # Imported here, and not with the first goal, because it takes a while.
                import asyncio  # noqa: F401
            action.perform = lambda goal, given: _performed(function, action, goal, given)
            self._actions[action.name] = action
            return function

        return known if function is None else known(function)

    def run(self, arguments: list[str] | None = None, *, without_leases: bool = False) -> None:
        """Serves goals until the process is told to end, by a signal or by the end of its standard input.

        ``arguments`` are those that a template passes; default: those of the process. Output of ``logging`` goes to the worker's log (``ratn logs``).
        With ``without_leases`` every caller may have goals performed: for trying it out.
        """
        self._serve(arguments, without_leases, None)

    def _serve(self, arguments: list[str] | None, without_leases: bool, driven: Driven | None) -> None:
        if not self._actions:
            raise ValueError("the worker has no actions: decorate a function with `@worker.action`")
        if not logging.getLogger().handlers:
            logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
        arguments = sys.argv[1:] if arguments is None else arguments
        kind = self.kind or "".join(part.capitalize() for part in self.provider.split("_"))
        _ratn.serve(arguments, self.provider, kind, list(self._actions.values()), without_leases, driven)


@dataclass
class Driven:
    """The settings of a driver in the form that the native part takes."""

    brakes: Callable[[str, str], object]
    stop_file: pathlib.Path | None
    standstill_s: float | None


class Driver(Worker):
    """A worker that moves something: with emergency stop, hold and standstill.

    ``brakes`` registers the function that stops and releases it. ``standstill_s`` is the time within which everything stands still after a lease has
    ended: the next lease is granted when the driver has confirmed standstill, or after this time; its template needs a ``standstill_ms`` of at least
    that. A ``stop_file`` keeps an emergency stop beyond the end of the process; it belongs in a state directory. Without it, a process that replaces
    one that ended during a stop does not know of that stop, and releases the brakes.
    """

    def __init__(
        self,
        provider: str | None = None,
        *,
        kind: str | None = None,
        standstill_s: float | None = None,
        stop_file: str | pathlib.Path | None = None,
    ) -> None:
        super().__init__(provider, kind=kind)
        self._standstill_s, self._stop_file = standstill_s, None if stop_file is None else pathlib.Path(stop_file)
        self._brakes: Callable[[str, str], object] | None = None

    def brakes(self, function: Callable[[str, str], object]) -> Callable[[str, str], object]:
        """Registers the function for the brakes: ``@d.brakes`` above ``def brake(state, reason): …``.

        It is called with ``"held"``, ``"stopped"`` or ``"ready"`` and with who requested it and why, from another thread than the goals. For the
        first two it returns when nothing moves; if it raises, the stop is in force and not confirmed. At the start it is called with ``"held"`` and
        then with ``"ready"``, because an earlier process may have begun a motion; if a stop is kept, with ``"stopped"``, and with ``"ready"`` only
        when the stop is cleared. No goal begins before it has returned; in a pool, all of that has to fit into the template's ``start_timeout_s``. It
        may be called again for a state that it has already carried out. An emergency stop does not wait for an earlier call to return, so it may find
        a device that the earlier call still uses; the stop is confirmed when the earlier call has returned and the brakes have been called once more,
        whatever they raised before, so that the newest state counts.
        """
        if any(kind(function) for kind in (inspect.iscoroutinefunction, inspect.isgeneratorfunction, inspect.isasyncgenfunction)):
            raise TypeError(f"{_ports.where(function)}: the brakes are a plain function, without `async` and `yield`: nothing moves when it has returned")
        self._brakes = function
        return function

    def run(self, arguments: list[str] | None = None, *, without_leases: bool = False) -> None:
        """Serves goals until the process is told to end. A driver always requires leases."""
        if without_leases:
            raise ValueError("a driver moves something: it performs goals only for whoever holds it")
        if self._brakes is None:
            raise ValueError("the driver has no brakes: decorate a function with `@driver.brakes`, which returns when nothing moves")
        arguments = sys.argv[1:] if arguments is None else arguments
        brakes = self._brakes

        def apply(state: str, reason: str) -> None:
            said = brakes(state, reason)
            if inspect.isawaitable(said) or inspect.isgenerator(said):
                getattr(said, "close", lambda: None)()
                raise TypeError(f"the brakes returned a {type(said).__name__}, so they have not done anything: nothing moves when they have returned")

        self._serve(_at_a_socket(arguments), False, Driven(apply, self._stop_file, self._standstill_s))


def _at_a_socket(arguments: list[str]) -> list[str]:
    """Adds a Unix socket as the address, unless the arguments give one: over it the system knows the user who releases the driver."""
    words = [word for argument in arguments for word in argument.split("=", 1)]
    given = {name: value for name, value in zip(words, words[1:]) if name.startswith("--")}
    manager, file = given.get("--resource-manager", ""), given.get("--endpoint-file", "")
    socket = f"{file.removesuffix('.endpoint')}.sock" if file else ""
    if not file and manager.startswith("unix:") and "--id" in given:
        socket = str(pathlib.Path(manager.removeprefix("unix:")).parent / f"{given['--id']}.sock")
    # A longer path is not possible for a socket.
    is_one = bool(socket) and len(socket.encode()) < 108
    return [*arguments, "--listen", f"unix:{socket}"] if is_one and "--listen" not in words else arguments


def _name_of_script() -> str:
    script = pathlib.Path(getattr(sys.modules.get("__main__"), "__file__", None) or "worker").stem
    return "".join(letter if letter.isalnum() else "_" for letter in script).lower().strip("_") or "worker"


def _performed(
    function: Callable[..., Any], action: _ports.Action, goal: Goal, given: dict[str, Any]
) -> tuple[str, dict[str, Any], str]:
    for port in action.arrays & given.keys():
        import numpy

        if given[port] is not None:
            # Without a copy, if it is contiguous memory already.
            given[port] = numpy.asarray(given[port], dtype=None if isinstance(given[port], Numbers) else float)
    # The goal gets a context of its own, because its thread performs other goals after it.
    context, process = contextvars.copy_context(), os.getpid()
    try:
        ended = context.run(function, goal, **given)
        if inspect.isawaitable(ended):
            import asyncio

            ended = context.run(asyncio.run, _until_cancelled(goal, ended))
        if os.getpid() != process:
            _leave_fork(None)
    except BaseException as raised:
        if os.getpid() != process:
            _leave_fork(raised)
        meant = _meant(raised)
        if meant is raised:
            raise
        raise meant from None
    name, outputs, reason = (ended.name, ended.outputs, ended.reason) if isinstance(ended, Outcome) else ("success", ended, "")
    outputs = {} if outputs is None else outputs
    if not isinstance(outputs, dict):
        raise TypeError(f"{_ports.where(function)} returned a {type(outputs).__name__}: expected a dict of outputs, or an Outcome")
    kinds = dict(action.outputs)
    return name, {port: _ports.fitting(value, kinds.get(port, "any")) for port, value in outputs.items()}, str(reason)


def _leave_fork(raised: BaseException | None) -> NoReturn:
    """Ends a process that an action has forked and that has returned here: the goal belongs to the parent process."""
    code = 0 if raised is None else 1
    try:
        if isinstance(raised, SystemExit):
            code = raised.code if isinstance(raised.code, int) else 0 if raised.code is None else 1
        elif raised is not None:
            sys.excepthook(type(raised), raised, raised.__traceback__)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        # Whatever could not be flushed: nothing else of this process may go on.
        os._exit(code & 0xFF)


def _meant(raised: BaseException) -> BaseException:
    """The exception that ends the goal, from the exception group of an `asyncio.TaskGroup` if the group has no other ones; else what was raised."""
    group = getattr(builtins, "BaseExceptionGroup", ())
    each, waiting = [], [raised]
    while waiting:
        one = waiting.pop(0)
        if isinstance(one, group):
            waiting += one.exceptions
        else:
            each.append(one)
    kinds = (Cancelled, Lost, Aborted)
    wanted = [one for kind in kinds for one in each if isinstance(one, kind)]
    return wanted[0] if len(wanted) == len(each) else raised


async def _until_cancelled(goal: Goal, work: Any) -> Any:
    """Awaits an ``async def``, which is cancelled in the way of asyncio when the goal is told to stop."""
    import asyncio

    task = asyncio.ensure_future(work)
    loop = asyncio.get_running_loop()

    def cancel() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(task.cancel)

    goal.on_cancel(cancel)
    try:
        return await task
    except asyncio.CancelledError:
        if goal.cancelled:
            raise Cancelled("the goal shall stop") from None
        raise
