"""Adds the resources of states that declare none: they block the provider of their action, as ``arm.follow(…)`` of an actions module does."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from typing import Any

from ratn import _ratn, _source
from ratn._annotations import VALUES
from ratn._ratn import Error

#: Actions in the form of `ratn actions --json`, by `provider/action`.
Offers = dict[str, dict[str, Any]]


@cache
def of_catalogues(*catalogues: str) -> Offers:
    """The actions of the built-in catalogue and of further ones in TOML."""
    providers = json.loads(_ratn.catalogue(list(catalogues)))["providers"]
    return {
        f"{name}/{action}": {"resource": provider["resource"], **signature} for name, provider in providers.items() for action, signature in provider["actions"].items()
    }


def of_system(runtime_dir: object, config: object = None) -> Offers:
    """The actions of a running system, whose workers describe themselves, or of a config."""
    from ratn._system import _told

    words = ["actions", "--json"]
    words += ["--runtime-dir", str(runtime_dir)] if runtime_dir is not None else []
    words += ["--config", str(config)] if config is not None else []
    told = _told(words)
    if told.returncode != 0:
        raise Error(told.stderr.strip())
    return {action["action"]: action for action in json.loads(told.stdout)}


def block_what_performs(value: Any, offers: Callable[[str], dict[str, Any] | None], around: frozenset[str] = frozenset()) -> None:
    """Adds resources to states without any, at all depths, unless an outer state blocks the provider. `offers` is called for the actions."""
    if isinstance(value, list):
        for item in value:
            block_what_performs(_source.named(item)[1] if isinstance(item, dict) else item, offers, around)
    if not isinstance(value, dict):
        return
    if isinstance(value.get("action"), str) and "resources" not in value:
        offer = offers(value["action"])
        said = {} if offer is None else offer.get("annotations") or {}
        if offer is not None and not said.get("resources") and offer["resource"] not in around:
            value["resources"] = resources(offer["resource"], {**said, **value})
    around |= _blocked(value.get("resources"))
    for key, inside in value.items():
        # Expressions, and values that contain some, are no states.
        if key not in ("in", "with", *VALUES):
            block_what_performs(inside, offers, around)


def resources(kind: str, said: dict[str, Any]) -> list[str]:
    """The resources of a state whose action a provider of this kind performs: the provider, and room for a projection if it computes and reads the world."""
    return [kind, "world_model"] if said.get("computes") is True and said.get("reads") != [] else [kind]


def _blocked(said: Any) -> set[str]:
    each = said if isinstance(said, list) else []
    kinds = (one.get("block") if isinstance(one, dict) else one for one in each)
    return {kind for kind in kinds if isinstance(kind, str)}
