"""A driver whose brakes let go only when the file `let_go` is there, where the file `slow` is. What they have done last is in the file `motor`. Where the
file `one_line` is, they raise while another call of them is under way."""

import pathlib
import sys
import threading
import time

import ratn

d = ratn.Driver("slow_brakes", kind="SlowBrakes", standstill_s=2.0)
folder = pathlib.Path(__file__).parent
line = threading.Lock()


@d.brakes
def brakes(state: str, reason: str) -> None:
    print(f"brakes: {state} begins", file=sys.stderr, flush=True)
    if not (folder / "one_line").exists():
        return work(state)
    if not line.acquire(blocking=False):
        raise RuntimeError("the line is busy")
    try:
        work(state)
    finally:
        line.release()


def work(state: str) -> None:
    while state == "ready" and (folder / "slow").exists() and not (folder / "let_go").exists():
        time.sleep(0.02)
    (folder / "motor").write_text(state)
    print(f"brakes: {state} done", file=sys.stderr, flush=True)


@d.action(effects=["moved(slow_brakes)"])
def move(goal: ratn.Goal) -> dict:
    return {}


d.run()
