"""What an export keeps must not grow with the log: a million events take hardly more memory than a twentieth of them.

    python check-exports-memory.py RATN FOLDER [EVENTS]        a million unless given
"""

import json
import os
import subprocess
import sys
import time

ratn, folder = sys.argv[1:3]
events = int(sys.argv[3]) if len(sys.argv) > 3 else 1_000_000
# The index of an MCAP file has some 100 bytes for each MiB.
MAY_GROW_KB = 8 * 1024
REQUIREMENT = {"operation": "block", "kind": "PathPlanner", "class": None, "attributes": {}, "count": 1}


def lease(i):
    return {"id": i + 1, "token": i + 1, "resources": [{"id": f"p{i % 4}", "kind": "PathPlanner", "endpoint": ""}]}


def write(path, events):
    """A planner plans again and again in a window of four, until there are so many events (and three times as many lines)."""
    with open(path, "w") as file:
        def line(at, **said):
            file.write(json.dumps({"at": at, **said}, separators=(",", ":")) + "\n")

        line(0, event="started", task="long", digest="d", mode="cdtn", parameters={}, seed=1, world=[], revision=0, capacity={"PathPlanner": 4})
        for i in range(events // 2):
            at, new, old = i * 1_000_000, i + 1, i - 3
            line(at, command="note", note="expanded", instance=new, state=1, path=f"all[{i}]/plan", speculative=False)
            line(at, command="acquire", instance=new, requirements=[REQUIREMENT], priority=1)
            if old >= 1:
                line(at, event="finished", instance=old, attempt=1, outcome="success", outputs={}, measured=[], reason="")
                line(at, command="note", note="finished", instance=old, outcome="success")
                line(at, command="note", note="retired", instance=old)
                line(at, command="release", instance=old, lease=old, projection=None)
            goal = {"provider": "path_planner", "action": "plan", "inputs": {}, "seed": 1, "lease": lease(i), "projection": 1, "expected_s": None}
            line(at, event="granted", instance=new, lease=lease(i))
            line(at, command="start", instance=new, attempt=1, goal=goal)


def most_kb(form, log):
    began = time.monotonic()
    child = subprocess.Popen([ratn, "export", *form, log], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    assert status == 0, f"{form} of {log}: {status}"
    return usage.ru_maxrss, time.monotonic() - began


short, long = f"{folder}/short.jsonl", f"{folder}/long.jsonl"
write(short, events // 20)
write(long, events)
for form in (["perfetto"], ["otlp"], ["mcap"], ["csv"], ["dot"], ["mermaid"], ["dot", "--of", "task"]):
    few, _ = most_kb(form, short)
    many, took = most_kb(form, long)
    print(f"{' '.join(form)}: {events} events in {took:.1f} s with at most {many} kB resident; {events // 20} with {few} kB", flush=True)
    assert many - few < MAY_GROW_KB, "what is kept grows with the log"
os.remove(long)
