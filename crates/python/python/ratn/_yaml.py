"""Writes the tree of a task file as YAML, and maps its lines to lines of a Python file."""

from __future__ import annotations

import json
import re
from typing import Any

_PLAIN = re.compile(r"[A-Za-z_$][A-Za-z0-9_$./]*\Z")
_SPECIAL = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}
_WIDTH = 110


class Body(dict[str, Any]):
    """The mapping of a state, with the Python line that made it."""

    line: tuple[str, int] | None = None


class Lines:
    """The text of a document, line by line."""

    def __init__(self) -> None:
        self.text: list[str] = []
        #: Line numbers of the text, from 1, and the Python line that made what begins there.
        self.origins: list[tuple[int, tuple[str, int]]] = []

    def origin(self, line: int) -> tuple[str, int] | None:
        """The Python line that made the innermost state which contains a line."""
        found = None
        for begins, place in self.origins:
            if begins <= line:
                found = place
        return found


def scalar(value: Any) -> str:
    """Writes a number, a boolean, a text or null."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return int.__repr__(value)
    if isinstance(value, float):
        text = float.__repr__(value)
        return {"inf": ".inf", "-inf": "-.inf", "nan": ".nan"}.get(text, text)
    if not isinstance(value, str):
        raise TypeError(f"{value!r} stands in no task file")
    value = str.__str__(value)
    return value if _PLAIN.match(value) and value.lower() not in _SPECIAL else json.dumps(value, ensure_ascii=False)


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{scalar(key)}: {_flow(item)}" for key, item in value.items()) + " }" if value else "{}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return scalar(value)


def _is_flat(value: Any) -> bool:
    if isinstance(value, Body):
        return False
    if isinstance(value, dict):
        return all(_is_flat(item) for item in value.values())
    if isinstance(value, (list, tuple)):
        return all(_is_flat(item) for item in value)
    return True


def write(document: dict[str, Any]) -> Lines:
    """Writes a task file."""
    lines = Lines()
    _map(lines, document, "", "")
    return lines


def _map(lines: Lines, mapping: dict[str, Any], first: str, indent: str) -> None:
    """Writes the entries; the first one follows what is on the line already."""
    if isinstance(mapping, Body) and mapping.line is not None:
        lines.origins.append((len(lines.text) + 1, mapping.line))
    for index, (key, value) in enumerate(mapping.items()):
        head = f"{first if index == 0 else indent}{scalar(key)}:"
        _value(lines, head, value, indent)


def _value(lines: Lines, head: str, value: Any, indent: str) -> None:
    inline = f"{head} {_flow(value)}" if _is_flat(value) else ""
    is_small = not isinstance(value, (dict, list, tuple)) or not value
    if inline and (is_small or len(inline) <= _WIDTH):
        lines.text.append(inline)
    elif isinstance(value, dict):
        lines.text.append(head)
        _map(lines, value, indent + "  ", indent + "  ")
    elif isinstance(value, (list, tuple)):
        lines.text.append(head)
        _list(lines, value, indent + "  ")
    else:
        raise TypeError(f"{value!r} stands in no task file")


def _list(lines: Lines, items: Any, indent: str) -> None:
    for item in items:
        if isinstance(item, dict) and item and not (_is_flat(item) and len(_flow(item)) <= _WIDTH - len(indent)):
            _map(lines, item, indent + "- ", indent + "  ")
        else:
            lines.text.append(f"{indent}- {_flow(item)}")
