"""Writes docs/python-reference.md: what the docstrings of the package say."""

from __future__ import annotations

import inspect
import re
import sys
from typing import Any

import ratn

GROUPS = {
    "Systems and runs": ["System", "Run", "Result", "Lease", "Projected", "WorldWatch", "Fact"],
    "Views of a run": ["Log", "Nodes", "Why", "CriticalPath", "Report", "Chart", "Network"],
    "Tasks": ["task", "Task", "Finding", "State", "Doc", "output", "variable", "Annotations"],
    "What is in a task": [
        "sequence", "when", "otherwise", "lastly", "each", "collect", "while_", "do_while", "until", "retry", "concurrently", "action", "wait", "ask", "library", "leave", "block", "consume",
        "create", "delete",
    ],
    "Expressions": ["Value", "fn", "expr", "fact", "exists", "isin", "function"],
    "Steps, workers and drivers": ["step", "Step", "Worker", "Driver", "Outcome", "Goal"],
    "Values": ["Pose", "Joints", "Trajectory", "Numbers"],
}
#: Classes that nobody makes but the package.
NOT_MADE = {"Run", "Lease", "Projected", "WorldWatch", "Fact", "Nodes", "Why", "CriticalPath", "Report", "Chart", "Network", "Finding", "State", "Value", "Goal", "Annotations", "Step", "Task", "Numbers"}


def text(thing: object) -> str:
    said = inspect.getdoc(thing) or ""
    said = re.sub(r":(?:meth|func|class):`([^`]*)`", r"`\1`", said)
    said = said.replace("``", "`").replace("::\n", ":\n")
    # A block that is indented would be code, of which documents run every one.
    return re.sub(r"\n\s*\n\s*", "\n\n", said).strip()


def signature(name: str, thing: Any) -> str:
    try:
        shown = inspect.signature(thing)
    except (ValueError, TypeError):
        return name
    parameters = [one.replace(annotation=inspect.Parameter.empty) for one in shown.parameters.values() if one.name not in ("self", "slf")]
    parameters = [one.replace(default=...) if " object at 0x" in str(one) or "factory" in str(one) else one for one in parameters]
    return name + str(inspect.Signature(parameters)).replace("Ellipsis", "…")


def entry(name: str) -> list[str]:
    thing = getattr(ratn, name)
    is_class = isinstance(thing, type)
    is_made = callable(thing) and not (is_class and name in NOT_MADE)
    lines = [f"### `{signature(f'ratn.{name}', thing) if is_made else f'ratn.{name}'}`", "", text(thing), ""]
    if not is_class or name == "Annotations":
        return lines
    for key, member in sorted(vars(thing).items()):
        if key.startswith("_"):
            continue
        plain = member.__func__ if isinstance(member, (staticmethod, classmethod)) else member
        said = text(plain).replace("\n\n", " ").replace("\n", " ")
        if not said or not (callable(plain) or isinstance(member, property) or inspect.isgetsetdescriptor(member)):
            continue
        head = signature(key, plain) if callable(plain) else key
        lines.append(f"- `{head}`: {said}")
    return [*lines, ""] if lines[-1] else lines


def main() -> None:
    grouped = {name for names in GROUPS.values() for name in names}
    errors = [name for name in ratn.__all__ if isinstance(getattr(ratn, name), type) and issubclass(getattr(ratn, name), BaseException)]
    missing = set(ratn.__all__) - grouped - set(errors) - {"Functions"}
    if missing:
        raise SystemExit(f"in no group of the reference: {sorted(missing)}")
    lines = ["# Reference of the Python package", "", "Made of the docstrings by `crates/python/tests/reference.py`. [python.md](python.md) is for learning.", ""]
    for group, names in GROUPS.items():
        lines += [f"## {group}", ""]
        for name in names:
            lines += entry(name)
    lines += ["## Errors", "", "| exception | is a | |", "|---|---|---|"]
    for name in errors:
        kind = getattr(ratn, name)
        lines.append(f"| `ratn.{name}` | `{kind.__mro__[1].__name__}` | {text(kind).split(chr(10) * 2)[0].replace(chr(10), ' ')} |")
    sys.stdout.write("\n".join(lines).rstrip() + "\n")


if __name__ == "__main__":
    main()
