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
"""

import pkgutil

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
    Joints,
    Lease,
    Lost,
    Malformed,
    NotFound,
    PermissionDenied,
    Pose,
    Refused,
    ResourceExhausted,
    Trajectory,
    Unavailable,
    WorldWatch,
)
from ratn._system import Result, Run, System
from ratn._worker import Outcome, Worker

# What `protoc` makes of the protocol's files is `ratn.v1`, in a folder of its own.
__path__ = pkgutil.extend_path(__path__, __name__)

__all__ = [
    "Aborted",
    "AlreadyExists",
    "Cancelled",
    "DeadlineExceeded",
    "Error",
    "Fact",
    "FailedPrecondition",
    "Goal",
    "InvalidArgument",
    "Joints",
    "Lease",
    "Lost",
    "Malformed",
    "NotFound",
    "Outcome",
    "PermissionDenied",
    "Pose",
    "Refused",
    "ResourceExhausted",
    "Result",
    "Run",
    "System",
    "Trajectory",
    "Unavailable",
    "Worker",
    "WorldWatch",
]
