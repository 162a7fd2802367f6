"""A real system for tests: `ratn up` with a config of the test's own, in a folder of its own."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[3]
TESTS = pathlib.Path(__file__).resolve().parent


def program() -> str:
    """The `ratn` under test: `RATN`, which `scripts/check-python` sets."""
    named = os.environ.get("RATN")
    if not named:
        pytest.exit("RATN is not set: run `scripts/check-python`, or set it to the path of a built `ratn`", returncode=2)
    return named


class Place:
    """A folder with the files of one system, and its runtime directory."""

    def __init__(self, folder: pathlib.Path) -> None:
        self.folder = folder
        # A socket's path has at most 107 bytes.
        self.runtime = folder / "run"
        self.runs = 0
        self.environment = {**os.environ, "RATN_RUNTIME_DIR": str(self.runtime), "PYTHONUNBUFFERED": "1"}

    def write(self, name: str, text: str) -> pathlib.Path:
        file = self.folder / name
        file.write_text(text)
        return file

    def ratn(self, *arguments: str | pathlib.Path, timeout: float = 120) -> subprocess.CompletedProcess[str]:
        command = [program(), *map(str, arguments)]
        return subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=timeout)

    def run(self, task: pathlib.Path, *arguments: str, timeout: float = 120) -> dict:
        """Runs a task; the result, with the log's lines."""
        self.runs += 1
        log = self.folder / f"{task.stem}-{self.runs}.jsonl"
        ended = self.ratn("run", task, "--runtime-dir", self.runtime, "--log", log, "--json", *arguments, timeout=timeout)
        assert ended.stdout.strip().startswith("{"), f"{ended.stdout}\n{ended.stderr}\n{self.logs()}"
        return {**json.loads(ended.stdout), "stderr": ended.stderr, "log": log.read_text()}

    def logs(self) -> str:
        return "\n".join(f"== {file.name}\n{file.read_text()}" for file in sorted((self.runtime / "logs").glob("*.log")))

    @contextlib.contextmanager
    def up(self, config: pathlib.Path, *arguments: str) -> Iterator[None]:
        """A system that is up, and ended in order afterwards."""
        command = [program(), "up", "--config", str(config), "--runtime-dir", str(self.runtime), *arguments]
        output = (self.folder / "up.log").open("w+")
        system = subprocess.Popen(command, env=self.environment, stdout=output, stderr=subprocess.STDOUT, cwd=self.folder)
        try:
            until = time.monotonic() + 60
            while "the system is ready" not in (said := (self.folder / "up.log").read_text()):
                assert system.poll() is None and time.monotonic() < until, f"{said}\n{self.logs()}"
                time.sleep(0.05)
            yield
        finally:
            system.send_signal(signal.SIGINT)
            try:
                system.wait(20)
            except subprocess.TimeoutExpired:
                system.kill()
                system.wait()
            output.close()


@pytest.fixture
def place() -> Iterator[Place]:
    with tempfile.TemporaryDirectory(prefix="ratn-py-") as folder:
        yield Place(pathlib.Path(folder))


def template(name: str, kind: str, **keys: object) -> str:
    """A template of a config, with its keys as TOML."""
    lines = [f"{key} = {json.dumps(value)}" for key, value in {"name": name, "kind": kind, **keys}.items()]
    return "\n".join(["[[process-manager.template]]", *lines, ""])


PYTHON = sys.executable
