"""A driver whose brakes let go only when the file `let_go` is there, where the file `slow` is. What they have done last is in the file `motor`."""

import pathlib
import sys
import time

import ratn

d = ratn.Driver("slow_brakes", kind="SlowBrakes", standstill_s=2.0)
folder = pathlib.Path(__file__).parent


@d.brakes
def brakes(state: str, reason: str) -> None:
    print(f"brakes: {state} begins", file=sys.stderr, flush=True)
    while state == "ready" and (folder / "slow").exists() and not (folder / "let_go").exists():
        time.sleep(0.02)
    (folder / "motor").write_text(state)
    print(f"brakes: {state} done", file=sys.stderr, flush=True)


@d.action(effects=["moved(slow_brakes)"])
def move(goal: ratn.Goal) -> dict:
    return {}


d.run()
