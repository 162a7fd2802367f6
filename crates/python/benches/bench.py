"""What a Python worker costs: a dependent hop, many small goals, work that fills processors, an idle worker; beside others.

One JSON document on standard output. Times are of the wall clock; quote ratios of one run.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import ratn

WORKER = """
import os, ratn
w = ratn.Worker("bench", kind="Bench")

@w.action(outputs={"value": "int", "pid": "int"})
def add(goal: ratn.Goal, value: int) -> dict:
    return {"value": value + 1, "pid": os.getpid()}

@w.action(outputs={"total": "int", "pid": "int"})
def spin(goal: ratn.Goal, rounds: int) -> dict:
    total = 0
    for number in range(rounds):
        total += number
    return {"total": total, "pid": os.getpid()}

w.run()
"""
SPIN = 3_000_000
HOPS = 200


def spin(rounds: int) -> int:
    total = 0
    for number in range(rounds):
        total += number
    return total


@contextlib.contextmanager
def system(workers: int) -> Iterator[ratn.System]:
    with tempfile.TemporaryDirectory(prefix="ratn-bench-") as folder:
        place = pathlib.Path(folder)
        (place / "worker.py").write_text(WORKER)
        (place / "system.toml").write_text(
            'catalogues = ["built-in"]\n[process-manager]\nhost = "compute"\n[[process-manager.template]]\n'
            f'name = "bench"\nkind = "Bench"\npython = "worker.py"\ninterpreter = {json.dumps(sys.executable)}\nmin = {workers}\nmax = {workers}\n'
        )
        with ratn.System(place / "system.toml", runtime_dir=place / "run", speed=1) as running:
            yield running


def state(name: str, action: str, inputs: str) -> str:
    return f"  - {name}: {{ action: bench/{action}, in: {inputs}, computes: true, reads: [], resources: [Bench] }}\n"


def run(running: ratn.System, text: str) -> tuple[ratn.Nodes, Any]:
    with tempfile.TemporaryDirectory(prefix="ratn-bench-") as folder:
        file = pathlib.Path(folder) / "task.yaml"
        file.write_text(text)
        under_way = running.run(file)
        result = under_way.result(600)
        if not result.is_success:
            raise SystemExit(f"the bench's task has ended {result}: {under_way.messages()}")
        return under_way.nodes(), result


def hop(running: ratn.System) -> dict[str, float]:
    """A chain in which each state uses the result of the one before: time from the begin of one to that of the next."""
    states = [state("s0", "add", "{ value: 0 }"), *(state(f"s{n}", "add", f"{{ value: s{n - 1}.value }}") for n in range(1, HOPS))]
    nodes, _ = run(running, f"task: hops\nhorizon: {HOPS + 10}\nstates:\n{''.join(states)}")
    began = [node["began_s"] for node in nodes]
    lengths = [1e6 * (after - before) for before, after in zip(began[10:], began[11:])]
    return {"median_us": statistics.median(lengths), "p90_us": statistics.quantiles(lengths, n=10)[-1]}


def many(running: ratn.System, goals: int) -> dict[str, float]:
    text = f"task: many\nhorizon: 1100\nstates:\n  - for: i in range({goals})\n    do:\n" + state("s", "add", "{ value: $i }").replace("  - ", "      - ")
    nodes, _ = run(running, text)
    took_s = max(node["ended_s"] for node in nodes) - nodes[0]["began_s"]
    return {"goals": len(nodes), "per_s": len(nodes) / took_s}


def cpu_bound(running: ratn.System) -> float:
    states = "".join(state(f"s{n}", "spin", f"{{ rounds: {SPIN} }}") for n in range(8))
    nodes, _ = run(running, f"task: spins\nstates:\n{states}")
    return float(max(node["ended_s"] for node in nodes) - nodes[0]["began_s"])


def idle_mib(running: ratn.System) -> float:
    (pool,) = [pool for pool in running.pools() if pool["kind"] == "Bench"]
    return max(float(worker["resident_bytes"]) for worker in pool["workers"]) / 2**20


def ours(goals: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    with system(1) as running:
        found["idle_worker_mib"] = idle_mib(running)
        found["hop"] = hop(running)
        found["eight_cpu_bound_on_one_worker_s"] = cpu_bound(running)
    with system(2) as running:
        found["many"] = many(running, goals)
        found["eight_cpu_bound_on_two_workers_s"] = cpu_bound(running)
    return found


SERVER = """
import sys, grpc
from concurrent import futures

def add(request, context):
    return str(int(request) + 1).encode()

handler = grpc.method_handlers_generic_handler("bench.Bench", {"Add": grpc.unary_unary_rpc_method_handler(add)})
server = grpc.server(futures.ThreadPoolExecutor(1), handlers=[handler])
print(server.add_insecure_port("127.0.0.1:0"), flush=True)
server.start()
sys.stdin.read()
"""


def grpcio(goals: int) -> dict[str, Any]:
    """Servers of grpcio that add one, each a process, with texts as messages: without leases, logs and worlds."""
    import grpc

    with contextlib.ExitStack() as stack:
        calls = []
        for _ in range(2):
            server = stack.enter_context(subprocess.Popen([sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            assert server.stdin is not None and server.stdout is not None
            # The server ends when its standard input is closed, which happens before the wait for it.
            stack.callback(server.stdin.close)
            channel = stack.enter_context(grpc.insecure_channel(f"127.0.0.1:{server.stdout.readline().strip()}"))
            calls.append(channel.unary_unary("/bench.Bench/Add"))
        value, lengths = b"0", []
        for _ in range(HOPS + 10):
            began = time.perf_counter()
            value = calls[0](value)
            lengths.append(1e6 * (time.perf_counter() - began))
        began = time.perf_counter()
        for one in [calls[number % 2].future(b"1") for number in range(goals)]:
            one.result()
        took_s = time.perf_counter() - began
    return {"hop": {"median_us": statistics.median(lengths[10:])}, "many": {"per_s": goals / took_s}}


def ray(goals: int) -> dict[str, Any]:
    import ray as rival

    rival.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    add = rival.remote(lambda value: value + 1)
    turn = rival.remote(spin)
    found = of_futures(add.remote, turn.remote, rival.get, goals)
    rival.shutdown()
    return found


def dask(goals: int) -> dict[str, Any]:
    from distributed import Client

    with Client(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as client:
        return of_futures(
            lambda value: client.submit(lambda v: v + 1, value, pure=False),
            lambda rounds: client.submit(spin, rounds, pure=False),
            lambda got: client.gather(got),
            goals,
        )


def of_futures(add: Callable[[Any], Any], turn: Callable[[int], Any], get: Callable[[Any], Any], goals: int) -> dict[str, Any]:
    get(add(0))
    began = time.perf_counter()
    value: Any = 0
    for _ in range(HOPS):
        value = add(value)
    get(value)
    hop_us = 1e6 * (time.perf_counter() - began) / HOPS
    began = time.perf_counter()
    get([add(n) for n in range(goals)])
    per_s = goals / (time.perf_counter() - began)
    began = time.perf_counter()
    get([turn(SPIN) for _ in range(8)])
    return {"hop": {"mean_us": hop_us}, "many": {"per_s": per_s}, "eight_cpu_bound_on_two_workers_s": time.perf_counter() - began}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--goals", type=int, default=1000)
    parser.add_argument("--without-rivals", action="store_true")
    given = parser.parse_args()
    found: dict[str, Any] = {"python": sys.version.split()[0], "processors": os.cpu_count(), "ratn": ours(given.goals)}
    began = time.perf_counter()
    for _ in range(8):
        spin(SPIN)
    found["eight_cpu_bound_in_this_process_s"] = time.perf_counter() - began
    rivals: dict[str, Callable[[int], dict[str, Any]]] = {"grpc": grpcio}
    if not given.without_rivals:
        rivals |= {"ray": ray, "distributed": dask}
    for module, measure in rivals.items():
        found[module] = measure(given.goals) if importlib.util.find_spec(module) else "not installed"
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
