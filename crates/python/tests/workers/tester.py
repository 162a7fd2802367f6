"""Actions that do what tests need."""

import asyncio
import contextlib
import contextvars
import logging
import multiprocessing
import os
import pathlib
import signal
import sys
import threading
import time
import weakref
from typing import Annotated, Any, TypedDict

import numpy as np
import ratn

w = ratn.Worker("tester", kind="Tester")
log = logging.getLogger("tester")


class Sums(TypedDict):
    total: float
    joints: ratn.Joints
    count: int


places: contextvars.ContextVar[int] = contextvars.ContextVar("places", default=0)


@w.action(computes=True)
def of_its_own(goal: ratn.Goal, given: int) -> dict:
    """What the goal before it has left in the context of its thread; leaves something there itself."""
    before = places.get()
    places.set(given)
    return {"before": before}


@w.action
def add(goal: ratn.Goal, numbers: np.ndarray, factor: float = 2.0) -> Sums:
    """Adds numbers. Numpy's arrays come and go."""
    assert isinstance(numbers, np.ndarray) and numbers.dtype == float
    return {"total": numbers.sum() * factor, "joints": numbers * factor, "count": np.int64(len(numbers))}


@w.action(outputs={"echo": "any"})
def echo(goal: ratn.Goal, value: Any) -> dict:
    return {"echo": value}


@w.action(outcomes=["odd"], outputs={"half": int})
def halve(goal: ratn.Goal, number: int) -> dict:
    if number % 2:
        return ratn.Outcome("odd", reason=f"{number} is odd")
    return {"half": number // 2}


@w.action
def crash(goal: ratn.Goal) -> dict:
    log.info("before the crash")
    return {"never": [][7]}


@w.action
async def nap(goal: ratn.Goal, seconds: float) -> dict:
    goal.progress("asleep", seconds=seconds)
    try:
        await asyncio.sleep(seconds)
    except asyncio.CancelledError:
        log.info("woken")
        raise
    return {"slept": seconds}


@w.action(anytime=True, effects=[], reads=[])
def price(goal: ratn.Goal, item: str, half_file: str = "") -> TypedDict("Price", {"item": str, "cost": int}):
    """A price, and lower ones as long as nobody pays. It makes a file when half of it is left."""
    first = {"item": item, "cost": 100}
    if goal.improves is None:
        return first
    for cost in range(100, 0, -1):
        goal.improved({"item": item, "cost": cost}, cost_s=cost)
        if cost == 50 and half_file:
            pathlib.Path(half_file).touch()
        goal.sleep(0.02)
    return first


@w.action
def await_file(goal: ratn.Goal, file: str, at_most_s: float) -> TypedDict("Awaited", {"there": bool}):
    """Waits until a file is there, for at most so many seconds."""
    until = time.monotonic() + at_most_s
    while not pathlib.Path(file).exists() and time.monotonic() < until:
        goal.sleep(0.02)
    return {"there": pathlib.Path(file).exists()}


@w.action
def pay(goal: ratn.Goal, cost: int) -> TypedDict("Paid", {"paid": int}):
    return {"paid": cost}


@w.action
def wait(goal: ratn.Goal, seconds: float) -> dict:
    try:
        goal.sleep(seconds)
    except ratn.Cancelled:
        log.info("cancelled")
        raise
    return {"slept": seconds}


@w.action
def spin(goal: ratn.Goal, rounds: int) -> dict:
    began = time.perf_counter()
    total = 0
    for number in range(rounds):
        total += number
    return {"took_s": time.perf_counter() - began, "pid": os.getpid()}


@w.action(senses=["at(?)"])
def look(goal: ratn.Goal) -> None:
    goal.measured("at(ball)", ratn.Pose(1, 2, 3), covariance=np.eye(6) * 0.25, source="eye")


@w.action(computes=True, reads=[])
def leave(goal: ratn.Goal, how: str) -> dict:
    if how == "interrupt":
        raise KeyboardInterrupt("by the action")
    sys.exit("no more of this")
    return {}


@w.action(outputs={"codes": list[int]}, computes=True, reads=[])
def forks(goal: ratn.Goal) -> dict:
    """Its children leave by what an action may leave by, too."""
    codes = []
    for ending in ("exit", "return", "raise"):
        child = os.fork()
        if child == 0:
            if ending == "exit":
                sys.exit(7)
            if ending == "raise":
                raise ValueError("of the child")
            return {"codes": []}
        codes.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    return {"codes": codes}


@w.action(outputs={"refused": list[str]}, reads=["at(?)"], effects=[])
def asks_in_a_fork(goal: ratn.Goal) -> dict:
    """What a child of `multiprocessing`, which forks, is told of everything that it asks the goal."""
    fork = multiprocessing.get_context("fork")
    said, own = fork.Pipe(duplex=False)

    def ask() -> None:
        # Whoever waits for ever is ended.
        signal.alarm(20)
        asked = {
            "cancelled": lambda: goal.cancelled, "checkpoint": goal.checkpoint, "sleep": lambda: goal.sleep(0), "while_held": goal.while_held, "facts": lambda: goal.facts("at(?)"),
            "progress": lambda: goal.progress("on"), "improved": lambda: goal.improved({}, cost_s=1), "measured": lambda: goal.measured("at(ball)", 1),
            "call": lambda: goal.call("Nearest", "nearest"), "on_cancel": lambda: goal.on_cancel(print),
        }
        for name, one in asked.items():
            try:
                one()
            except ratn.Error as refused:
                own.send(f"{name}: {refused}")

    child = fork.Process(target=ask)
    child.start()
    own.close()
    refused = []
    with contextlib.suppress(EOFError):
        while True:
            refused.append(said.recv())
    child.join()
    goal.facts("at(?)")
    return {"refused": refused}


class Unprintable(Exception):
    def __str__(self) -> str:
        raise RuntimeError("has no text")


@w.action(computes=True, reads=[])
def unusual(goal: ratn.Goal, how: str) -> dict:
    if how == "long":
        raise ratn.Aborted("ä" * 20_000_000)
    if how == "group":
        raise BaseExceptionGroup("several", [ratn.Aborted("one"), SystemExit(3)])
    raise Unprintable
    return {}


@w.action(computes=True, reads=[])
async def leave_later(goal: ratn.Goal) -> dict:
    await asyncio.sleep(0)
    sys.exit("no more of that")
    return {}


@w.action(outputs={"refused": str}, computes=True, reads=[])
def tell(goal: ratn.Goal, length: int) -> dict:
    try:
        goal.progress("x" * length, picture=b"x" * length)
    except ValueError as refused:
        return {"refused": str(refused)}
    return {"refused": ""}


@w.action(computes=True, reads=[])
def tell_often(goal: ratn.Goal, times: int) -> dict:
    for number in range(times):
        goal.progress("once more", number=number)
        if number % 50 == 0:
            # Whoever listens keeps up.
            time.sleep(0.01)
    return {"times": times}


@w.action(outputs={"heard": str}, computes=True, reads=[])
def ask(goal: ratn.Goal) -> dict:
    try:
        goal.call("Nearest", "nearest", begin=ratn.Pose())
    except ratn.Aborted as refused:
        return {"heard": str(refused)}
    return {"heard": ""}


@w.action(computes=True, reads=[])
def through(goal: ratn.Goal, seconds: float) -> dict:
    goal.progress("calls")
    try:
        goal.call("Lingerer", "linger", seconds=seconds)
    except ratn.Cancelled:
        log.info("the call was given up")
        raise
    return {}


@w.action(computes=True, reads=[])
async def together(goal: ratn.Goal) -> dict:
    async def fail() -> None:
        raise ratn.Aborted("apart")

    async with asyncio.TaskGroup() as group:
        group.create_task(fail())
    return {}


class Heard:
    def __call__(self) -> None: ...


watching: weakref.WeakSet = weakref.WeakSet()


@w.action(outputs={"watching": int}, computes=True, reads=[])
def watched(goal: ratn.Goal) -> dict:
    """Zählt, was auf frühere Ziele noch hört 🤖."""
    before = len(watching)
    heard = Heard()
    watching.add(heard)
    goal.on_cancel(heard)
    return {"watching": before}


@w.action(computes=True, reads=[])
def deaf(goal: ratn.Goal) -> dict:
    """Does not let go of Python's lock until it has returned, and for a while after it was told to stop."""
    ended: list[bool] = []
    goal.on_cancel(lambda: log.info("deaf: told when it was over" if ended else "deaf: told in time"))
    usual = sys.getswitchinterval()
    again = threading.Timer(1.2, sys.setswitchinterval, [usual])
    again.start()
    sys.setswitchinterval(60)
    while not goal.cancelled:
        pass
    log.info("deaf: told to stop")
    until = time.monotonic() + 0.3
    while time.monotonic() < until:
        pass
    ended.append(True)
    return {}


class Drawn(TypedDict):
    picture: bytes
    rows: Annotated[Any, "list<list<float>>"]
    path: ratn.Trajectory


@w.action(computes=True, reads=[])
def draw(goal: ratn.Goal) -> Drawn:
    """Gives arrays of several kinds, however they lie in memory."""
    rows = np.arange(6.0).reshape(2, 3)
    path = ratn.Trajectory(["a", "b"], times_s=np.array([0.0, 1.0, 2.0]), positions=rows.T, velocities=rows.T * 0.5)
    return {"picture": np.arange(256, dtype=np.uint8), "rows": rows.T, "path": path}


def is_view(array: np.ndarray) -> bool:
    """Whether its memory is another object's, and nobody writes there."""
    return not array.flags.owndata and not array.flags.writeable


@w.action(computes=True, reads=[], outputs={"views": "map<bool>", "sums": "list<float>"})
def see(
    goal: ratn.Goal,
    picture: Annotated[np.ndarray, "bytes"],
    rows: Annotated[np.ndarray, "list<list<float>>"],
    path: ratn.Trajectory,
    numbers: np.ndarray,
    joints: Annotated[np.ndarray, "joints"],
) -> dict:
    """Says which of its inputs numpy looks at where they lie."""
    assert picture.dtype == np.uint8 and rows.shape == (3, 2) and np.asarray(path.positions).shape == (3, 2)
    arrays = {"picture": picture, "rows": rows, "numbers": numbers, "joints": joints}
    for name in ("times_s", "positions", "velocities"):
        arrays[name] = np.asarray(getattr(path, name))
        assert np.shares_memory(arrays[name], np.asarray(getattr(path, name)))
    sums = [float(array.sum()) for array in arrays.values()]
    return {"views": {name: is_view(array) for name, array in arrays.items()}, "sums": sums}


@w.action(reads=["at(?)"], effects=[], outputs={"covariance": "list<list<float>>", "views": "list<bool>"})
def sure(goal: ratn.Goal) -> dict:
    """How sure a measured fact is, as numpy sees it."""
    (fact,) = goal.facts("at(ball)")
    first, second = np.asarray(fact.covariance), np.asarray(fact.covariance)
    return {"covariance": first, "views": [is_view(first), np.shares_memory(first, second), fact.value is fact.value]}


@w.action(outputs={"joints": ratn.Joints, "given": bool}, computes=True, reads=[])
def odd(goal: ratn.Goal, numbers: np.ndarray | None = None) -> ratn.Outcome:
    return ratn.Outcome("success", {"joints": [1, 2.5], "given": isinstance(numbers, np.ndarray)})


w.run()
