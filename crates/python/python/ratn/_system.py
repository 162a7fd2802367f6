"""A system, and runs of tasks on it.

Daemons and runs are processes of the program ``ratn``, as on a command line: a run goes on however this process fares, and its event log
can be read by ``ratn report``. Resources and the world are asked for directly.
"""

from __future__ import annotations

import asyncio
import json
import os
import pathlib
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from ratn import _ratn
from ratn._ratn import Error, Fact, Lease, WorldWatch

_READY = "the system is ready"
_READY_WITHIN_S = 60.0
_ENDED_WITHIN_S = 20.0
_LOOK_S = 0.02


def _program() -> str:
    named = os.environ.get("RATN")
    found = named if named and os.access(named, os.X_OK) else shutil.which("ratn")
    if named and found != named:
        raise Error(f"RATN is `{named}`, which is no program: set it to the path of `ratn`")
    if found is None:
        raise Error("there is no program `ratn` in PATH: install it, or set RATN to its path")
    return found


def _default_directory() -> pathlib.Path:
    said = os.environ.get("RATN_RUNTIME_DIR")
    if said:
        return pathlib.Path(said)
    xdg = os.environ.get("XDG_RUNTIME_DIR")
    return pathlib.Path(xdg) / "ratn" if xdg else pathlib.Path(f"/tmp/ratn-{os.getuid()}")


@dataclass(frozen=True)
class Result:
    """How a run has ended."""

    outcome: str
    outputs: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    makespan_s: float = 0.0

    @property
    def is_success(self) -> bool:
        return self.outcome == "success"


class System:
    """A system that is up: the one of ``runtime_dir``, or one that is started for as long as this is open.

    Unless ``runtime_dir`` (or ``RATN_RUNTIME_DIR``) names one that runs, ``ratn up`` starts one, with ``config`` and in a folder of its
    own, and ``close()`` (or the end of the ``with`` block) ends it. ``options`` are further options of ``ratn up``: ``boxes=2``,
    ``planners=2``, ``seed=7``, ``speed=10``.
    """

    def __init__(
        self,
        config: str | os.PathLike[str] | None = None,
        *,
        runtime_dir: str | os.PathLike[str] | None = None,
        **options: object,
    ) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
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
        self._folder = tempfile.TemporaryDirectory(prefix="ratn-")
        folder = pathlib.Path(self._folder.name)
        self.runtime_dir = pathlib.Path(str(runtime_dir)) if runtime_dir is not None else folder / "run"
        command = [_program(), "up", "--runtime-dir", str(self.runtime_dir)]
        command += ["--config", str(config)] if config is not None else []
        for name, value in options.items():
            command += [f"--{name.replace('_', '-')}", str(value)]
        said = folder / "up.log"
        with said.open("w") as output:
            # A group of its own: Ctrl-C is for this process, which then ends the system in order.
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, text=True, start_new_session=True
            )
        until = time.monotonic() + _READY_WITHIN_S
        try:
            while _READY not in said.read_text():
                if self._process.poll() is not None:
                    raise Error(f"`ratn up` has ended: {said.read_text().strip()}")
                if time.monotonic() > until:
                    raise Error(f"the system was not ready within {_READY_WITHIN_S:.0f} s: {said.read_text().strip()}")
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
        """Gives back what is held, and ends the system if it was started here."""
        self._client.close()
        self._end()

    def _end(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(_ENDED_WITHIN_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._process = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def run(
        self,
        task: str | os.PathLike[str],
        *,
        mode: str = "cdtn",
        seed: int | None = None,
        log: str | os.PathLike[str] | None = None,
        **parameters: Any,
    ) -> Run:
        """Begins a run of a task file; its parameters are keyword arguments. ``mode`` is ``cdtn`` or ``hsm``."""
        return Run(self, task, mode, seed, log, parameters)

    def acquire(
        self, *kinds: str, priority: int = 0, timeout_s: float | None = None, holder: str = "python"
    ) -> Lease:
        """Waits until one resource of each kind is free and takes all of them: ``with system.acquire("PathPlanner") as lease:``.

        Raises ``ratn.DeadlineExceeded`` after ``timeout_s`` seconds of wall time.
        """
        return self._client.acquire(list(kinds), priority=priority, timeout_s=timeout_s, holder=holder)

    def resources(self, *kinds: str) -> list[dict[str, Any]]:
        """The resources, of these kinds where any is given."""
        return self._client.resources(*kinds)

    def query(self, *patterns: str) -> list[Fact]:
        """The facts of the world that match any of the patterns (``"at(?)"``); all of them without one."""
        return self._client.query(*patterns)

    def set(self, fact: str, value: Any) -> int:
        """Writes a fact, ``system.set("at(box_1)", ratn.Pose(1, 0, 0.7))``; ``None`` deletes it. Gives the world's revision."""
        return self._client.set(fact, value)

    def watch(self, *patterns: str) -> WorldWatch:
        """Iterates over what holds now and each change after it."""
        return self._client.watch(*patterns)


class Run:
    """A run under way. Iterating over it (``for`` or ``async for``) gives the events of its log as dicts, until it has ended."""

    def __init__(
        self,
        system: System,
        task: str | os.PathLike[str],
        mode: str,
        seed: int | None,
        log: str | os.PathLike[str] | None,
        parameters: dict[str, Any],
    ) -> None:
        self._system = system
        self._folder = tempfile.TemporaryDirectory(prefix="ratn-run-")
        folder = pathlib.Path(self._folder.name)
        #: The event log, which ``ratn report`` reads.
        self.log = pathlib.Path(log) if log is not None else folder / "run.jsonl"
        command = [_program(), "run", os.fspath(task), "--json", "--mode", mode]
        command += ["--runtime-dir", str(system.runtime_dir), "--log", str(self.log)]
        command += ["--seed", str(seed)] if seed is not None else []
        for name, value in parameters.items():
            command += ["--set", f"{name}={_ratn.as_written(value)}"]
        self._said, self._told = folder / "result.json", folder / "messages"
        with self._said.open("w") as output, self._told.open("w") as messages:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=messages, start_new_session=True)

    def __repr__(self) -> str:
        return f"<Run {'under way' if self._process.poll() is None else 'ended'}, log {self.log}>"

    @property
    def under_way(self) -> bool:
        return self._process.poll() is None

    def messages(self) -> str:
        """What the run has told people so far."""
        return self._told.read_text()

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
        """The lines of the log as they come, several at a time; nothing where none has come yet."""
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
        """Waits for the end. A run that ends badly is no exception: its outcome says so. One that cannot begin is a ``ratn.Error``."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"the run has not ended within {timeout_s} s") from None
        text = self._said.read_text().strip()
        if not text:
            raise Error(self.messages().strip() or f"the run has ended with code {self._process.returncode}")
        said = json.loads(text)
        return Result(said["outcome"], said.get("outputs", {}), said.get("reason", ""), said.get("makespan_s", 0.0))

    def _control(self, word: str) -> str:
        command = [_program(), "control", word, "--runtime-dir", str(self._system.runtime_dir)]
        told = subprocess.run(command, capture_output=True, text=True)
        if told.returncode != 0:
            raise Error(told.stderr.strip() or f"`ratn control {word}` has ended with code {told.returncode}")
        return told.stdout.strip()

    def pause(self) -> str:
        """No further state begins that acts for real; what runs goes on."""
        return self._control("pause")

    def step(self) -> str:
        """One such state begins, then the run pauses again."""
        return self._control("step")

    def resume(self) -> str:
        """Ends a pause."""
        return self._control("resume")

    def abort(self) -> str:
        """Ends the run: motions stop, everything is given back."""
        return self._control("abort")

    def report(self) -> dict[str, Any]:
        """What ``ratn report --json`` tells of the log so far."""
        told = subprocess.run([_program(), "report", str(self.log), "--json"], capture_output=True, text=True)
        if told.returncode != 0:
            raise Error(told.stderr.strip())
        report: dict[str, Any] = json.loads(told.stdout)
        return report

    def nodes(self) -> list[dict[str, Any]]:
        """A record of each attempt to perform a node, in the order in which they began.

        ``path`` (``for_box[0]/move``), ``provider``, ``action``, ``attempt``, ``began_s`` and ``ended_s`` (the robot's seconds since the
        run began), ``outcome`` and ``reason``. What is under way, or was given up, has ``None`` as its end and outcome.
        """
        # What follows the last line end is a line that is being written.
        return _nodes(json.loads(line) for line in self.log.read_text().split("\n")[:-1])


def _nodes(lines: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    began_ns: int | None = None
    paths: dict[int, str] = {}
    nodes: dict[tuple[int, int], dict[str, Any]] = {}
    for line in lines:
        began_ns = line["at"] if began_ns is None else began_ns
        at_s = (line["at"] - began_ns) / 1e9
        if line.get("note") == "expanded":
            paths[line["instance"]] = line["path"]
        elif line.get("command") == "start":
            goal, key = line["goal"], (line["instance"], line["attempt"])
            nodes[key] = {
                "path": paths.get(line["instance"], ""),
                "provider": goal["provider"],
                "action": goal["action"],
                "attempt": line["attempt"],
                "began_s": at_s,
                "ended_s": None,
                "outcome": None,
                "reason": "",
            }
        elif line.get("event") == "finished" and (line["instance"], line["attempt"]) in nodes:
            ended = {"ended_s": at_s, "outcome": line["outcome"], "reason": line["reason"]}
            nodes[line["instance"], line["attempt"]].update(ended)
    return list(nodes.values())
