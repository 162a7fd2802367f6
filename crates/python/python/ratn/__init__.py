"""Workers, runs and systems of `ratn`, from Python.

A worker in a file of its own::

    import ratn

    w = ratn.Worker()

    @w.action(reads=["at(?)"])
    def nearest(goal: ratn.Goal, start: ratn.Pose, within_m: float = 9.0) -> dict:
        best = min(goal.facts("at(?)"), key=lambda f: f.value.distance(start), default=None)
        if best is None:
            raise ratn.Aborted("nothing so near")
        return {"object": best.key[0]}

    w.run()

A system and a run::

    with ratn.System() as system:
        result = system.run("fetch_boxes.yaml", boxes=2).result()

A task is a function, which is called once and makes the same model as a task file::

    from ratn.actions import detector, pan_tilt

    @ratn.task
    def look() -> None:
        pan_tilt.look_at(target=ratn.Pose(0.8, 0, 0.7))
        seen = detector.segment(region={"pose": ratn.Pose(0.8, 0, 0.7), "size": [0.6, 1.2]}, resources=["Detector", "Camera"])
        with ratn.when(ratn.fn.len(seen.boxes) > 0):
            ...
"""

import importlib
import pkgutil
import typing

from ratn._ratn import (
    Aborted,
    AlreadyExists,
    Cancelled,
    DeadlineExceeded,
    Error,
    Fact,
    FailedPrecondition,
    Goal,
    InvalidArgument,
    InvalidTask,
    Joints,
    Lease,
    Lost,
    Malformed,
    NotFound,
    Numbers,
    OutOfRange,
    PermissionDenied,
    Pose,
    Projected,
    Refused,
    ResourceExhausted,
    Trajectory,
    Unauthenticated,
    Unavailable,
    Unimplemented,
    WorldWatch,
)
from ratn._worker import Driver, Outcome, Worker

if typing.TYPE_CHECKING:
    from ratn._annotations import Annotations, block, consume, create, delete, output
    from ratn._blocks import collect, concurrently, do_while, each, lastly, otherwise, retry, sequence, until, when, while_
    from ratn._expression import Functions, Untraceable, Value, exists, expr, fact, fn, isin
    from ratn._states import action, ask, function, leave, library, variable, wait
    from ratn._step import Step, step
    from ratn._system import Result, Run, System
    from ratn._task import Doc, Finding, Task, task
    from ratn._trace import State
    from ratn._views import Chart, CriticalPath, Log, Network, Nodes, Report, Why

# The modules for tasks and systems are loaded on first use: a worker needs none of them, and there are many workers.
_LATER = {
    "_annotations": "Annotations block consume create delete output",
    "_blocks": "collect concurrently do_while each lastly otherwise retry sequence until when while_",
    "_expression": "Functions Untraceable Value exists expr fact fn isin",
    "_states": "action ask function leave library variable wait",
    "_step": "Step step",
    "_system": "Result Run System",
    "_task": "Doc Finding Task task",
    "_trace": "State",
    "_views": "Chart CriticalPath Log Network Nodes Report Why",
}
_PLACES = {name: module for module, names in _LATER.items() for name in names.split()}


def __getattr__(name: str) -> typing.Any:
    """Loads a name on first use (PEP 562)."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


# The Python modules that `protoc` generates from the protocol's files are `ratn.v1`, in a folder of their own.
__path__ = pkgutil.extend_path(__path__, __name__)

__all__ = [
    "Aborted",
    "AlreadyExists",
    "Annotations",
    "Cancelled",
    "Chart",
    "CriticalPath",
    "DeadlineExceeded",
    "Doc",
    "Driver",
    "Error",
    "Fact",
    "FailedPrecondition",
    "Finding",
    "Functions",
    "Goal",
    "InvalidArgument",
    "InvalidTask",
    "Joints",
    "Lease",
    "Log",
    "Lost",
    "Malformed",
    "Network",
    "Nodes",
    "NotFound",
    "Numbers",
    "OutOfRange",
    "Outcome",
    "PermissionDenied",
    "Pose",
    "Projected",
    "Refused",
    "Report",
    "ResourceExhausted",
    "Result",
    "Run",
    "State",
    "Step",
    "System",
    "Task",
    "Trajectory",
    "Unauthenticated",
    "Unavailable",
    "Unimplemented",
    "Untraceable",
    "Value",
    "Why",
    "Worker",
    "WorldWatch",
    "action",
    "ask",
    "block",
    "collect",
    "concurrently",
    "consume",
    "create",
    "delete",
    "do_while",
    "each",
    "exists",
    "expr",
    "fact",
    "fn",
    "function",
    "isin",
    "lastly",
    "leave",
    "library",
    "otherwise",
    "output",
    "retry",
    "sequence",
    "step",
    "task",
    "until",
    "variable",
    "wait",
    "when",
    "while_",
]
