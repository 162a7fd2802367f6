"""A system, and runs of tasks on it.

Daemons and runs are processes of the program ``ratn``, as on a command line: a run goes on however this process fares, and its event log
can be read by ``ratn report``. Resources and the world are asked for directly.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import json
import os
import pathlib
import re
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import AsyncIterator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ratn import _ratn, _resources, _views
from ratn._expression import expression, literal
from ratn._ratn import Error, Fact, Lease, Projected, WorldWatch
from ratn._step import kind_of, refuse_while_read
from ratn._task import Task

_READY = "the system is ready"
_READY_WITHIN_S = 60.0
_ENDED_WITHIN_S = 20.0
_LOOK_S = 0.02
#: Interval of checks whether the workers of steps exist, and the maximum number of replacements in a run.
_LOOK_AT_WORKERS_S = 0.2
_WORKERS_AGAIN = 3
#: Variables that a process manager sets for its pooled workers. They are removed for workers of steps, which are never pooled.
_OF_POOLED = ("RATN_PROVIDER_SESSION", "RATN_RESOURCE_MANAGER", "RATN_STANDSTILL_MS", "RATN_STUCK_TIMEOUT_MS", "RATN_WORKER_LISTEN")


def _program() -> str:
    named = os.environ.get("RATN")
    found = named if named and os.access(named, os.X_OK) else shutil.which("ratn")
    if named and found != named:
        raise Error(f"RATN is `{named}`, which is no program: set it to the path of `ratn`")
    if found is None:
        raise Error("there is no program `ratn` in PATH: install it, or set RATN to its path")
    return found


def _told(words: list[str]) -> subprocess.CompletedProcess[str]:
    """Runs the program, and returns its output."""
    return subprocess.run([_program(), *words], capture_output=True, text=True, encoding="utf-8", errors="replace")


def _environment() -> dict[str, str]:
    """The environment of the daemons: Python workers whose template names no interpreter use the one of this virtual environment, active or not."""
    own = {"VIRTUAL_ENV": sys.prefix} if sys.prefix != sys.base_prefix else {}
    return {**os.environ, **own}


def _text_of(file: pathlib.Path) -> str:
    """The output of a process, decoded as far as it is text."""
    return file.read_text(encoding="utf-8", errors="replace")


def _remove(folder: str, maker: _ratn.Process, processes: list[subprocess.Popen[Any]]) -> None:
    """Removes a folder, unless a process still writes into it. Does nothing in a fork of the process that made it."""
    if maker.is_here and all(process.poll() is not None for process in processes):
        shutil.rmtree(folder, ignore_errors=True)


def _default_directory() -> pathlib.Path:
    said = os.environ.get("RATN_RUNTIME_DIR")
    if said:
        return pathlib.Path(said)
    xdg = os.environ.get("XDG_RUNTIME_DIR")
    return pathlib.Path(xdg) / "ratn" if xdg else pathlib.Path(f"/tmp/ratn-{os.getuid()}")


def _due(due: float | str | datetime.timedelta | datetime.datetime) -> str:
    """A due time in the form that ``ratn run`` takes."""
    if isinstance(due, datetime.datetime):
        return due.astimezone(datetime.timezone.utc).isoformat()
    if isinstance(due, datetime.timedelta):
        due = due.total_seconds()
    return due if isinstance(due, str) else f"{due}s"


@dataclass(frozen=True)
class Result:
    """The result of a run."""

    outcome: str
    outputs: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    makespan_s: float = 0.0

    @property
    def is_success(self) -> bool:
        """Whether the outcome is ``success``."""
        return self.outcome == "success"


class System:
    """A running system: the one of ``runtime_dir``, or one that is started for as long as this object is open.

    Unless ``runtime_dir`` (or ``RATN_RUNTIME_DIR``) names a running system, ``ratn up`` starts one, with ``config`` and in its own folder, and
    ``close()`` (or the end of the ``with`` block) ends it. ``options`` are further options of ``ratn up``: ``boxes=2``, ``planners=2``, ``seed=7``,
    ``speed=10``.
    """

    def __init__(
        self,
        config: str | os.PathLike[str] | None = None,
        *,
        runtime_dir: str | os.PathLike[str] | None = None,
        **options: object,
    ) -> None:
        refuse_while_read("it would start a system")
        self._process: subprocess.Popen[str] | None = None
        self._clean: weakref.finalize[..., System] | None = None
        self._maker = _ratn.Process()
        directory = pathlib.Path(runtime_dir) if runtime_dir is not None else _default_directory()
        if config is None and not options and (directory / "resource-manager.endpoint").exists():
            self.runtime_dir = directory
        else:
            self._start(config, runtime_dir, options)
        try:
            self._client = _ratn.Client(self.runtime_dir)
        except BaseException:
            self._end()
            raise

    def _start(self, config: object, runtime_dir: object, options: dict[str, object]) -> None:
        folder = pathlib.Path(tempfile.mkdtemp(prefix="ratn-"))
        # Without `close()` the system ends with this object; its output is then no longer accessible, so it is not kept.
        self._clean = weakref.finalize(self, _remove, str(folder), self._maker, [])
        self.runtime_dir = pathlib.Path(str(runtime_dir)) if runtime_dir is not None else folder / "run"
        command = [_program(), "up", "--exit-with-parent", "--runtime-dir", str(self.runtime_dir)]
        command += ["--config", str(config)] if config is not None else []
        for name, value in options.items():
            command += [f"--{name.replace('_', '-')}", str(value)]
        said = folder / "up.log"
        with said.open("w") as output:
            # A group of its own: Ctrl-C is for this process, which then ends the system in order. The pipe ends with this process,
            # however that ended, and the system with it.
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, text=True, start_new_session=True, env=_environment()
            )
        until = time.monotonic() + _READY_WITHIN_S
        try:
            while _READY not in _text_of(said):
                if self._process.poll() is not None:
                    raise Error(f"`ratn up` has ended: {_text_of(said).strip()}")
                if time.monotonic() > until:
                    raise Error(f"the system was not ready within {_READY_WITHIN_S:.0f} s: {_text_of(said).strip()}")
                time.sleep(_LOOK_S)
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> System:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<System at {self.runtime_dir}{'' if self._process is None else ', started here'}>"

    def close(self) -> None:
        """Releases what is held, and ends the system if it was started here. In a fork of the process that opened it, it ends nothing."""
        try:
            self._client.close()
        finally:
            self._end()

    def _end(self) -> None:
        if not self._maker.is_here:
            return
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_ENDED_WITHIN_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
        self._process = None
        if self._clean is not None:
            self._clean()
            self._clean = None

    def run(
        self,
        task: str | os.PathLike[str] | Task,
        *,
        mode: str = "cdtn",
        seed: int | None = None,
        log: str | os.PathLike[str] | None = None,
        step_workers: int = 1,
        alone: bool = False,
        urgency: str = "normal",
        share: float = 1.0,
        due: float | str | datetime.timedelta | datetime.datetime | None = None,
        parameters: Mapping[str, Any] | None = None,
        **others: Any,
    ) -> Run:
        """Begins a run of a task, or of a task file. Its parameters are keyword arguments; parameters named like an option of this method go into
        ``parameters`` (``parameters={"due": 3}``). ``mode`` is ``cdtn`` or ``hsm``.

        It runs beside other runs of the system, unless it or one of them is ``alone``. ``urgency`` (``low``, ``normal``, ``high``) says whose needs
        come first. ``share`` (0.01 to 100) is its weight, relative to the other runs, for resources that several runs need. ``due`` is when it should
        have ended: seconds from its start or a ``timedelta``, a ``datetime`` (local time if it has no zone), or a text as for ``ratn run --due``
        (``"15m"``); if several runs need a resource at about the same time, the run that is due first comes first. The steps of a task
        (``@ratn.step``) are performed by the run's own workers, which end with it: ``step_workers`` processes for each file. The log is written to
        ``log``, or else to a temporary folder, which is removed with the ``Run`` object unless the run is still under way.
        """
        self._client.check_open()
        given = {**(parameters or {}), **others}
        if twice := set(parameters or {}) & set(others):
            raise TypeError(f"parameter `{min(twice)}` is given twice, by its name and in `parameters`")
        return Run(self, task, mode, seed, log, given, step_workers, alone, urgency, share, due)

    def acquire(
        self, *kinds: str, priority: int = 0, timeout_s: float | None = None, holder: str = "python"
    ) -> Lease:
        """Waits until one resource of each kind is free and acquires all of them: ``with system.acquire("PathPlanner") as lease:``.

        Raises ``ratn.DeadlineExceeded`` after ``timeout_s`` seconds of wall time; ``None`` and infinity wait without limit.
        """
        return self._client.acquire(list(kinds), priority=priority, timeout_s=timeout_s, holder=holder)

    def resources(self, *kinds: str) -> list[dict[str, Any]]:
        """The resources; only those of the given kinds, if any are given."""
        return self._client.resources(*kinds)

    def pools(self) -> list[dict[str, Any]]:
        """The pools of worker processes on all hosts, as printed by ``ratn ps --json``."""
        self._client.check_open()
        told = _told(["ps", "--json", "--runtime-dir", str(self.runtime_dir)])
        if not told.stdout.strip():
            raise Error(told.stderr.strip() or f"`ratn ps` has ended with code {told.returncode}")
        said = json.loads(told.stdout)
        return [{"host": host["host"], **pool} for host in said["hosts"] for pool in host.get("pools", [])]

    def query(self, *patterns: str) -> list[Fact]:
        """The facts of the world that match any of the patterns (``"at(?)"``); all facts if no pattern is given."""
        return self._client.query(*patterns)

    def set(self, fact: str, value: Any) -> int:
        """Writes a fact, ``system.set("at(box_1)", ratn.Pose(1, 0, 0.7))``; ``None`` deletes it. Returns the world's revision."""
        return self._client.set(fact, value)

    def project(self, changes: Mapping[str, Any], *, timeout_s: float | None = None) -> Projected:
        """Creates a projection (a hypothetical world): ``with system.project({"at(box_1)": ratn.Pose(1, 0, 0.7)}) as world: world.query("at(?)")``.

        It is the present world with changes (``None`` deletes) that nobody else sees. It holds a ``WorldModel`` resource, for which it waits.
        """
        return self._client.project(list(changes.items()), timeout_s=timeout_s)

    def watch(self, *patterns: str) -> WorldWatch:
        """Iterates over the present facts, then over each change."""
        return self._client.watch(*patterns)


@dataclass(frozen=True)
class _OfSteps:
    """A worker of steps."""

    id: str
    provider: str
    file: str
    said: pathlib.Path


class _Child(subprocess.Popen[Any]):
    """A process that is waited for by the process that started it. In a fork, a wait would report it as ended."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self._maker = _ratn.Process()
        super().__init__(*given, **named)

    def poll(self) -> int | None:
        self._maker.check("this run", "ask for its `id` and its `log`, and start `ratn control` or `ratn report`")
        return super().poll()

    def wait(self, timeout: float | None = None) -> int:
        self.poll()
        return super().wait(timeout)


class Run:
    """A run under way. Iterating over it (``for`` or ``async for``) yields the events of its log as dicts, until it has ended."""

    def __init__(
        self,
        system: System,
        task: str | os.PathLike[str] | Task,
        mode: str,
        seed: int | None,
        log: str | os.PathLike[str] | None,
        parameters: dict[str, Any],
        step_workers: int = 1,
        alone: bool = False,
        urgency: str = "normal",
        share: float = 1.0,
        due: float | str | datetime.timedelta | datetime.datetime | None = None,
    ) -> None:
        self._system = system
        folder = pathlib.Path(tempfile.mkdtemp(prefix="ratn-run-"))
        self._processes: list[subprocess.Popen[Any]] = []
        self._maker = _ratn.Process()
        weakref.finalize(self, _remove, str(folder), self._maker, self._processes)
        #: The path of the event log, which ``ratn report`` reads.
        self.log = pathlib.Path(log) if log is not None else folder / "run.jsonl"
        self._workers: list[subprocess.Popen[bytes]] = []
        self._of_steps: list[_OfSteps] = []
        self._begun, self._lost = 0, ""
        steps: dict[str, str] = {}
        if isinstance(task, Task):
            task = task._knowing(lambda: _resources.of_system(system.runtime_dir))
            # Steps are performed only by workers of this run: another run may have other workers for the same file.
            token = secrets.token_hex(4)
            providers = {provider: f"{provider}_{token}" for provider in task._step_files()}
            steps = {providers[provider]: file for provider, file in task._step_files().items()}
            file = folder / f"{re.sub(r'[^A-Za-z0-9_]', '_', task.name) or 'task'}.yaml"
            file.write_text((task._with_providers(providers) if providers else task).standing_alone(), encoding="utf-8")
            task = file
        command = [_program(), "run", os.fspath(task), "--json", "--mode", mode]
        command += ["--runtime-dir", str(system.runtime_dir), "--log", str(self.log)]
        command += ["--seed", str(seed)] if seed is not None else []
        command += ["--urgency", urgency, *(["--alone"] if alone else []), f"--share={share}"]
        command += [f"--due={_due(due)}"] if due is not None else []
        for name, value in parameters.items():
            # Texts are passed as literals.
            command += ["--set", f"{name}={literal(value) if isinstance(value, str) else expression(value)}"]
        self._said, self._told = folder / "result.json", folder / "messages"
        self._start_steps(steps, step_workers, folder)
        try:
            with self._said.open("w") as output, self._told.open("w") as messages:
                self._process = _Child(command, stdin=subprocess.DEVNULL, stdout=output, stderr=messages, start_new_session=True)
        except BaseException:
            self._end_steps()
            raise
        self._processes.append(self._process)
        if self._workers:
            # The workers end with the run, even if its result is never asked for.
            threading.Thread(target=self._end_with_run, args=[folder], daemon=True).start()

    def _start_steps(self, steps: dict[str, str], each: int, folder: pathlib.Path) -> None:
        """Starts the workers of steps, one or more for each provider with its file; they offer themselves to the system."""
        if not steps:
            return
        if each < 1:
            raise ValueError(f"step_workers is {each}: the steps of a task need a worker")
        kinds, each_of = {kind_of(provider) for provider in steps}, [one for one in steps.items() for _ in range(each)]
        until = time.monotonic() + _READY_WITHIN_S
        try:
            for provider, file in each_of:
                self._start_worker(provider, file, folder)
            while not {step.id for step in self._of_steps} <= {resource["id"] for resource in self._system.resources(*kinds)}:
                for worker, step in zip(self._workers, self._of_steps):
                    if worker.poll() is not None:
                        raise Error(f"the worker of the steps has ended: {_text_of(step.said).strip()}")
                if time.monotonic() > until:
                    said = _text_of(self._of_steps[0].said).strip()
                    raise Error(f"the worker of the steps was not ready within {_READY_WITHIN_S:.0f} s: {said}")
                time.sleep(_LOOK_S)
        except BaseException:
            self._end_steps()
            raise

    def _start_worker(self, provider: str, file: str, folder: pathlib.Path, place: int | None = None) -> None:
        """Starts a worker of steps, possibly as the replacement of one that has ended."""
        self._begun += 1
        name = f"{provider.replace('_', '-')}-{self._begun}"
        said = folder / f"{name}.log"
        manager = (self._system.runtime_dir / "resource-manager.endpoint").read_text(encoding="utf-8").strip()
        command = [sys.executable, "-m", "ratn._step", file, provider, "--id", name, "--kind", kind_of(provider), "--resource-manager", manager]
        command.append("--exit-with-parent")
        environment = {name: value for name, value in os.environ.items() if name not in _OF_POOLED}
        with said.open("wb") as output:
            worker = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, start_new_session=True, env=environment
            )
        step = _OfSteps(name, provider, file, said)
        if place is None:
            self._workers.append(worker)
            self._of_steps.append(step)
        else:
            self._workers[place], self._of_steps[place] = worker, step

    def _end_with_run(self, folder: pathlib.Path) -> None:
        """Replaces workers that end before the run does: without any worker the run would wait for ever."""
        left = _WORKERS_AGAIN
        try:
            while True:
                try:
                    self._process.wait(_LOOK_AT_WORKERS_S)
                    break
                except subprocess.TimeoutExpired:
                    pass
                for place, (worker, step) in enumerate(zip(self._workers, self._of_steps)):
                    if worker.poll() is None or self._lost:
                        continue
                    if left > 0:
                        left -= 1
                        self._start_again(step, folder, place)
                    elif not self._has_worker(step.file):
                        said = _text_of(step.said).strip()
                        self._lost = f"a worker of the steps in {step.file} has ended, and {_WORKERS_AGAIN} others before it: {said}"
                        self._abort_without_steps()
        finally:
            self._end_steps()

    def _start_again(self, step: _OfSteps, folder: pathlib.Path, place: int) -> None:
        """Replaces a worker that has ended; if that fails, the next round tries again."""
        try:
            self._start_worker(step.provider, step.file, folder, place)
        except OSError as error:
            # The resource manager may be restarting, or the system cannot start a process.
            with contextlib.suppress(OSError), step.said.open("a", encoding="utf-8") as said:
                said.write(f"\nno other worker could be started in its place: {error}\n")

    def _has_worker(self, file: str) -> bool:
        """Whether the worker of the steps in a file still exists."""
        return any(step.file == file and worker.poll() is None for worker, step in zip(self._workers, self._of_steps))

    def _abort_without_steps(self) -> None:
        try:
            self.abort()
        except (Error, OSError):
            # It is ending, or does not listen: terminate its process.
            self._process.terminate()

    def _end_steps(self) -> None:
        for worker in self._workers:
            if worker.stdin is not None:
                worker.stdin.close()
            worker.terminate()
        for worker in self._workers:
            try:
                worker.wait(_ENDED_WITHIN_S)
            except subprocess.TimeoutExpired:
                worker.kill()
                worker.wait()

    def __repr__(self) -> str:
        stage = "of another process" if not self._maker.is_here else "under way" if self.under_way else "ended"
        return f"<Run {stage}, log {self.log}>"

    @property
    def under_way(self) -> bool:
        """Whether the run has not ended."""
        return self._process.poll() is None

    def messages(self) -> str:
        """The run's messages for people so far."""
        return _text_of(self._told)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for events in self._pieces():
            if not events:
                time.sleep(_LOOK_S)
            yield from events

    async def __aiter__(self) -> AsyncIterator[dict[str, Any]]:
        for events in self._pieces():
            if not events:
                await asyncio.sleep(_LOOK_S)
            for event in events:
                yield event

    def _pieces(self) -> Iterator[list[dict[str, Any]]]:
        """The lines of the log as they arrive, several at a time; an empty piece if there are none yet."""
        rest, read = b"", 0
        while True:
            ended = not self.under_way
            if self.log.exists():
                with self.log.open("rb") as log:
                    log.seek(read)
                    came = log.read()
                read += len(came)
                *lines, rest = (rest + came).split(b"\n")
                if lines:
                    yield [json.loads(line) for line in lines if line]
                    continue
            if ended:
                return
            yield []

    def result(self, timeout_s: float | None = None) -> Result:
        """Waits for the end of the run; at most ``timeout_s`` seconds (then ``TimeoutError``), unless that is ``None`` or infinite. A failed run raises
        no exception: its outcome says so. A run that cannot begin raises a ``ratn.Error``.
        """
        try:
            self._process.wait(_ratn.patience_s("timeout_s", timeout_s))
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"the run has not ended within {timeout_s} s") from None
        try:
            said = json.loads(_text_of(self._said))
        except ValueError:
            # The run could not begin, or was killed.
            raise Error(self.messages().strip() or f"the run has ended with code {self._process.returncode}") from None
        reason = "; ".join(part for part in (said.get("reason", ""), self._lost) if part)
        return Result(said["outcome"], said.get("outputs", {}), reason, said.get("makespan_s", 0.0))

    @property
    def id(self) -> str:
        """The id of the run, unique in the system."""
        self._wait_for_log()
        with self.log.open("rb") as log:
            return str(json.loads(log.readline())["origin"]["run"])

    def _control(self, *words: str) -> str:
        return self._tell(["control", *words, "--run", self.id])

    def _tell(self, words: list[str]) -> str:
        told = _told([*words, "--runtime-dir", str(self._system.runtime_dir)])
        if told.returncode != 0:
            if self._maker.is_here and not self.under_way:
                raise Error(f"the run has ended, so `{words[0]}` comes too late; `result()` says how it ended")
            raise Error(told.stderr.strip() or f"`ratn {words[0]}` has ended with code {told.returncode}")
        return told.stdout.strip()

    def signal(self, name: str, value: Any = None) -> None:
        """Sends a signal with a value, for which a state of the task waits (``ratn.wait(signal="order")``). It is kept until a state takes it."""
        said = [] if value is None else [expression(value)]
        if any("\0" in text for text in said):
            raise ValueError("a text with NUL in it cannot be sent")
        self._tell(["signal", self.id, name, *said])

    def answer(self, choice: str, *, state: str | None = None) -> None:
        """Answers the question of a state (``ratn.ask``); if several states ask, ``state`` is the path of one."""
        self._tell(["answer", self.id, choice, *(["--state", state] if state is not None else [])])

    def pause(self) -> str:
        """Pauses: no further state that acts begins; states under way go on."""
        return self._control("pause")

    def step(self) -> str:
        """Lets one state that acts begin, then the run pauses again."""
        return self._control("step")

    def break_at(self, state: str) -> str:
        """Sets a breakpoint: the run pauses before a state that acts begins, at this path or inside of it (``for_box/grasp``); :meth:`resume` and
        :meth:`step` continue.
        """
        return self._control("break", state)

    def clear(self, state: str | None = None) -> str:
        """Removes the breakpoint at a state, or all."""
        return self._control("clear", *([] if state is None else [state]))

    def resume(self) -> str:
        """Ends a pause."""
        return self._control("resume")

    def abort(self) -> str:
        """Ends the run: motions stop, all resources are released."""
        return self._control("abort")

    def _wait_for_log(self) -> None:
        # A run that has just begun may not have written its first line yet.
        until = time.monotonic() + _ENDED_WITHIN_S
        while not (self.log.exists() and b"\n" in self.log.read_bytes()[:1_000_000]):
            if not self.under_way and not self.log.exists():
                raise Error(self.messages().strip() or f"the run has ended with code {self._process.returncode}, without a log")
            if time.monotonic() > until:
                raise Error(f"the run has written nothing within {_ENDED_WITHIN_S:.0f} s: {self.messages().strip()}")
            time.sleep(_LOOK_S)

    def _read(self) -> _views.Log:
        self._wait_for_log()
        return _views.Log(self.log)

    def report(self) -> _views.Report:
        """The output of ``ratn report --json`` for the log so far, as a dict that is shown as the table for people."""
        return self._read().report()

    def nodes(self) -> _views.Nodes:
        """One record per attempt to perform a node, in the order in which they began: see :meth:`Log.nodes`."""
        return self._read().nodes()

    def why(self, name: str) -> _views.Why:
        """What the visits of a state waited for, given by its path or name: ``print(run.why("move_2"))``."""
        return self._read().why(name)

    def critical_path(self) -> _views.CriticalPath:
        """The critical path: what the run waited for, from its start to its end. Empty if the run has not ended."""
        return self._read().critical_path()

    def gantt(self, by: str = "resource") -> _views.Chart:
        """The Gantt chart so far, as SVG; one row per ``resource`` or per ``node``."""
        return self._read().gantt(by)

    def network(self) -> _views.Network:
        """What each instance of a state waited for, as a graph."""
        told = _told(["export", "mermaid", str(self.log)])
        if told.returncode != 0:
            raise Error(told.stderr.strip())
        return _views.Network(told.stdout.strip())

    def _repr_html_(self) -> str:
        return self._read()._repr_html_()
