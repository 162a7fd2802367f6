"""``python -m ratn stubs`` and ``python -m ratn python FILE``."""

from __future__ import annotations

import argparse
import pathlib
import sys

from ratn import _stubs
from ratn._task import Task

_MODULE = '''"""Actions of {what}, for tasks; written by `python -m ratn stubs`."""

from ratn.actions import module

__getattr__, __dir__ = module({catalogue!r})
'''


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m ratn")
    commands = parser.add_subparsers(dest="command", required=True)
    stubs = commands.add_parser("stubs", help="write a module with the actions of a catalogue, and its stubs")
    stubs.add_argument("--catalogue", type=pathlib.Path, metavar="FILE", help="a catalogue, TOML, that extends the built-in one")
    stubs.add_argument("--runtime-dir", type=pathlib.Path, metavar="DIR", help="where a running system is, whose workers and config are asked instead")
    stubs.add_argument("module", type=pathlib.Path, nargs="?", help="`robot.py`; robot.pyi is written beside it. The stubs alone to standard output without it")
    python = commands.add_parser("python", help="print a task file as Python")
    python.add_argument("task", type=pathlib.Path, metavar="TASK")
    given = parser.parse_args()
    if given.command == "python":
        _write(Task.from_yaml(given.task).to_python())
        return
    catalogue = given.catalogue.read_text(encoding="utf-8") if given.catalogue else None
    if given.runtime_dir is not None:
        if catalogue is not None:
            parser.error("--catalogue or --runtime-dir, not both")
        catalogue = _stubs.catalogue_of_system(given.runtime_dir)
        given.catalogue = given.runtime_dir
    what = f"the built-in catalogue and {given.catalogue.name}" if given.catalogue else "the built-in catalogue"
    text = _stubs.stubs(catalogue, what)
    if given.module is None:
        _write(text)
        return
    given.module.write_text(_MODULE.format(what=what, catalogue=catalogue), encoding="utf-8")
    given.module.with_suffix(".pyi").write_text(text, encoding="utf-8")


def _write(text: str) -> None:
    """Writes source text as UTF-8, whatever the terminal's locale is."""
    sys.stdout.buffer.write(text.encode())
    sys.stdout.flush()


if __name__ == "__main__":
    main()
