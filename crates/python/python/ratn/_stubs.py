"""Stubs of the actions of a catalogue, for completion in editors and for type checkers."""

from __future__ import annotations

import json
import keyword
import os
import re
from typing import Any

from ratn import _ratn
from ratn._ratn import Error
from ratn._annotations import Annotations

_HEAD = '''"""Stubs of the actions of {what}, written by `python -m ratn stubs`."""

from collections.abc import Mapping, Sequence
from typing import Any

from typing_extensions import Unpack

import ratn
from ratn import Annotations, Value

'''
_KINDS = {
    "any": "object",
    "bool": "bool | Value",
    "int": "int | Value",
    "float": "float | Value",
    "string": "str | Value",
    "bytes": "bytes | Value",
    "pose": "ratn.Pose | Value",
    "joints": "ratn.Joints | Sequence[float] | Value",
    "trajectory": "ratn.Trajectory | Value",
}


_BARE = re.compile(r"[A-Za-z0-9_-]+\Z")


def _python(kind: str) -> str:
    if kind in _KINDS:
        return _KINDS[kind]
    if kind.startswith("list<"):
        return "Sequence[Any] | Value"
    return "Mapping[str, Any] | Value"


def stubs(catalogue: str | None, what: str) -> str:
    """The text of a ``.pyi`` with a class for each provider."""
    providers: dict[str, Any] = json.loads(_ratn.catalogue([] if catalogue is None else [catalogue]))["providers"]
    parts = [_HEAD.format(what=what)]
    for name, provider in sorted(item for item in providers.items() if _is_name(item[0])):
        parts.append(_provider(name, provider))
    return "".join(parts).rstrip() + "\n"


def _provider(name: str, provider: dict[str, Any]) -> str:
    states, methods = [], []
    # An action whose name is no Python name is performed by `ratn.action("provider/3d-scan", …)`.
    for action, signature in sorted(item for item in provider["actions"].items() if _is_name(item[0])):
        state = f"{_title(name)}_{_title(action)}"
        outputs = [port for port in sorted(signature.get("outputs", {})) if _is_name(port)]
        states.append(f"class _{state}(ratn.State):\n" + ("".join(f"    {port}: Value\n" for port in outputs) or "    ...\n"))
        ports = [(port, kind, "") for port, kind in sorted(signature.get("inputs", {}).items())]
        ports += [(port, kind, " = ...") for port, kind in sorted(signature.get("optional", {}).items())]
        given = "".join(f"        {port}: {_python(kind)}{default},\n" for port, kind, default in ports if _is_port(port))
        star = "        *,\n" if given else ""
        methods.append(f"    def {action}(\n        self,\n{star}{given}        **annotations: Unpack[Annotations],\n    ) -> _{state}:{_document(signature)}\n")
    title = _title(name)
    inside = "".join(methods) or "    ...\n"
    return "".join(f"{state}\n" for state in states) + f"class _{title}:\n{inside}\n{name}: _{title}\n\n"


def _title(name: str) -> str:
    """The name of a class, without underscores: one underscore separates the names of provider and action."""
    return "".join(part.capitalize() for part in name.split("_"))


def _document(signature: dict[str, Any]) -> str:
    text = str(signature.get("description", "")).replace("\\", "\\\\").replace('"""', "'''")
    text = f'{text[:-1]}\\"' if text.endswith('"') else text
    return f'\n        """{text}"""\n' if text else " ..."


def _is_name(port: str) -> bool:
    return port.isidentifier() and not keyword.iskeyword(port)


def _is_port(port: str) -> bool:
    # A port with the name of an annotation, or of another parameter, can be given only by `inputs={…}`.
    return _is_name(port) and port not in {*Annotations.__annotations__, "self", "annotations"}


def catalogue_of_system(runtime_dir: str | os.PathLike[str]) -> str:
    """The additions of a running system to the built-in catalogue, as TOML: from its config and its workers."""
    from ratn._system import _told

    told = _told(["actions", "--json", "--runtime-dir", os.fspath(runtime_dir)])
    if told.returncode != 0:
        raise Error(told.stderr.strip())
    return toml([action for action in json.loads(told.stdout) if action["from"] != "built in"])


def toml(actions: list[dict[str, Any]]) -> str:
    """A catalogue with these actions as TOML: each with ``action`` (``provider/action``), ``resource``, and its signature."""
    known = json.loads(_ratn.catalogue([]))
    kinds = sorted({action["resource"] for action in actions} - known["resources"].keys())
    lines = [line for kind in kinds for line in (f"[resources.{_key(kind)}]", 'class = "process"', "count = 64", "")]
    for provider, resource in sorted({(action["action"].partition("/")[0], action["resource"]) for action in actions}):
        lines += [f"[providers.{_key(provider)}]", f"resource = {_value(resource)}", ""]
    for action in actions:
        provider, _, name = action["action"].partition("/")
        lines.append(f"[providers.{_key(provider)}.actions.{_key(name)}]")
        lines += [f"{key} = {_value(action.get(key) or {})}" for key in ("inputs", "optional", "outputs", "defaults")]
        lines += [f"outcomes = {_value(action.get('outcomes') or [])}", f"description = {_value(action.get('description', ''))}"]
        said = {key: value for key, value in (action.get("annotations") or {}).items() if value is not None}
        lines += [*([f"annotations = {_value(said)}"] if said else []), ""]
    return "\n".join(lines)


def _key(name: str) -> str:
    return name if _BARE.match(name) else _value(name)


def _value(value: Any) -> str:
    """A text, a boolean, a list or a table of these, as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(str(key))} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    # A JSON string is a TOML string, except for surrogate pairs and DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
