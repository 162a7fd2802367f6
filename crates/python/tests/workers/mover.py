"""A driver of something that moves: a number that goes up while a goal runs."""

import pathlib
import sys
import threading

import ratn

d = ratn.Driver("mover", kind="Mover", standstill_s=2.0, stop_file=pathlib.Path(__file__).with_name("stop.json"))
moving = threading.Event()


@d.brakes
def brakes(state: str, reason: str) -> None:
    """Nothing moves when this has returned for a hold or a stop."""
    print(f"brakes: {state} {reason}", file=sys.stderr, flush=True)
    if state != "ready":
        moving.clear()


@d.action(effects=["moved(mover)"], suspends=True)
def move(goal: ratn.Goal, steps: int, step_s: float = 0.02) -> dict:
    """Moves so many steps."""
    for done in range(steps):
        goal.while_held()
        moving.set()
        goal.progress("moving", step=done)
        goal.sleep(step_s)
    moving.clear()
    return {"steps": steps}


d.run()
