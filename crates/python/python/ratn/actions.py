"""The actions of the built-in system, for tasks: ``from ratn.actions import arm, detector, gripper``.

Each provider has a function for each action; what a system of your own offers is a module that ``python -m ratn stubs`` writes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import Any

from ratn import _ratn
from ratn._states import Provider


@cache
def _catalogue(catalogue: str | None) -> dict[str, Any]:
    said: dict[str, Any] = json.loads(_ratn.catalogue([] if catalogue is None else [catalogue]))
    return said


def module(catalogue: str | None) -> tuple[Callable[[str], Provider], Callable[[], list[str]]]:
    """Returns ``__getattr__`` and ``__dir__`` for a module with the providers of a catalogue (TOML), which extends the built-in one."""

    def attribute(name: str) -> Provider:
        providers = _catalogue(catalogue)["providers"]
        if name not in providers:
            raise AttributeError(f"there is no provider `{name}`; there are {', '.join(sorted(providers))}")
        return Provider(name, providers[name], catalogue)

    def names() -> list[str]:
        return sorted(_catalogue(catalogue)["providers"])

    return attribute, names


__getattr__, __dir__ = module(None)
