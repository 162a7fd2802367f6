"""A system and its runs, resources and world, from Python."""

from __future__ import annotations

import asyncio
import datetime
import gc
import json
import os
import pathlib
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import TypedDict

import pytest
import ratn
from conftest import ROOT, Place, program

EXAMPLE = ROOT / "examples" / "fetch_boxes.yaml"


@ratn.step(reads=[])
def measure(of: int = 0) -> TypedDict("Measured", {"value": float}):
    return {"value": of + 0.5}


@ratn.task
def measures() -> dict:
    duration = measure(of=1)
    with ratn.sequence("decide"):
        outputs = measure(of=2)
    return {"values": [duration.value, outputs.value]}


@ratn.task
def dues(due: int = 1, mode: str = "fast") -> dict:
    measured = measure(of=due)
    return {"value": measured.value, "mode": mode}


@pytest.fixture(scope="module")
def system() -> Iterator[ratn.System]:
    os.environ["RATN"] = program()
    os.environ.pop("RATN_RUNTIME_DIR", None)
    with ratn.System(boxes=2, speed=50) as system:
        yield system


def test_a_run_gives_its_events_its_result_and_its_nodes(system: ratn.System) -> None:
    run = system.run(EXAMPLE, boxes=1, seed=3)
    events = list(run)
    assert events[0]["event"] == "started" and events[0]["parameters"]["boxes"] == {"int": 1}
    result = run.result()
    assert result.is_success and result.makespan_s > 0, run.messages()
    nodes = run.nodes()
    assert {"path", "provider", "action", "began_s", "ended_s", "outcome"} <= nodes[0].keys()
    moves = [node for node in nodes if node["action"] == "move_to"]
    assert moves and all(node["outcome"] == "success" and node["ended_s"] > node["began_s"] for node in moves)
    assert run.report()["makespan_s"] == pytest.approx(result.makespan_s)


def test_events_come_while_a_run_is_under_way_also_asynchronously(system: ratn.System) -> None:
    async def first() -> tuple[dict, bool]:
        run = system.run(EXAMPLE, boxes=1)
        async for event in run:
            under_way = run.under_way
            run.abort()
            run.result(60)
            return event, under_way
        raise AssertionError("no event")

    event, under_way = asyncio.run(first())
    assert event["event"] == "started" and under_way


def test_a_run_is_paused_stepped_and_aborted(system: ratn.System) -> None:
    run = system.run(EXAMPLE, boxes=1)
    for _ in run:
        break
    run.pause()
    run.step()
    run.resume()
    run.abort()
    result = run.result(60)
    assert not result.is_success and result.reason, result
    words = [event["event"] for event in run if "event" in event]
    for word in ("pause_requested", "step_requested", "resume_requested", "abort_requested"):
        assert word in words


def test_a_run_that_cannot_begin_says_why(system: ratn.System, tmp_path: pathlib.Path) -> None:
    broken = tmp_path / "broken.yaml"
    broken.write_text("task: broken\nstates:\n  - x: { action: no_such/thing }\n")
    with pytest.raises(ratn.Error, match="no_such"):
        system.run(broken).result(60)


def test_a_run_has_a_share_and_a_due_time(system: ratn.System) -> None:
    def standing(**said: object) -> tuple[float, float | None]:
        run = system.run(EXAMPLE, boxes=1, **said)
        id = run.id
        run.pause()
        words = ["status", "--json", "--runtime-dir", str(system.runtime_dir)]
        told = json.loads(subprocess.run([program(), *words], capture_output=True, text=True, check=True).stdout)
        run.abort()
        run.result(60)
        (own,) = [one for one in told["runs"] if one["run"] == id]
        return own["share"], own.get("due_in_s")

    assert standing() == (1.0, None)
    in_two_minutes = datetime.timedelta(minutes=2)
    at = [datetime.datetime.now() + in_two_minutes, datetime.datetime.now(datetime.timezone.utc) + in_two_minutes]
    for due in (120, 120.5, "2m", in_two_minutes, *at):
        share, due_in_s = standing(share=2.5, due=due)
        assert share == 2.5 and due_in_s is not None and 60 < due_in_s <= 120.5, (due, due_in_s)


@pytest.mark.parametrize(
    ("said", "expected"),
    [({"share": 0}, "from 0.01 to 100"), ({"due": -5}, "expected a time"), ({"due": "soon"}, "expected a time"), ({"due": datetime.datetime(2026, 1, 1)}, "has passed")],
)
def test_a_share_or_a_due_time_that_cannot_be_is_refused(system: ratn.System, said: dict, expected: str) -> None:
    with pytest.raises(ratn.Error, match=expected):
        system.run(EXAMPLE, boxes=1, **said).result(60)


def test_a_parameter_may_be_called_as_what_a_run_is_given(system: ratn.System) -> None:
    run = system.run(dues, due=60, parameters={"due": 7, "mode": "slow"})
    assert run.result(60).outputs == {"value": 7.5, "mode": "slow"}, run.messages()
    with pytest.raises(TypeError, match="`boxes` is given twice"):
        system.run(EXAMPLE, boxes=1, parameters={"boxes": 2})


def test_a_task_that_is_called_says_what_runs_it() -> None:
    with pytest.raises(TypeError, match=r"`system\.run\(dues, due=…\)`"):
        dues(due=3)


def test_a_resource_is_held_for_a_block_and_nobody_else_gets_it(system: ratn.System) -> None:
    with system.acquire("Camera", holder="a test") as lease:
        assert lease.alive and [kind for _, kind, _ in lease.resources] == ["Camera"]
        assert [resource["held"] for resource in system.resources("Camera")] == [True]
        with pytest.raises(ratn.DeadlineExceeded) as late:
            system.acquire("Camera", timeout_s=0.5)
        assert late.value.code == "DEADLINE_EXCEEDED" and "Camera" in str(late.value)
    assert [resource["held"] for resource in system.resources("Camera")] == [False]
    assert lease.release() is False


def test_what_a_block_raises_is_not_hidden_by_what_cannot_be_given_back_and_that_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda said: told.append(str(said.exc_value)))
    with ratn.System(boxes=1, speed=50) as own:
        with pytest.raises(KeyError):
            with own.acquire("Camera"):
                own._end()
                raise KeyError("inside")
    assert len(told) == 1, told


def test_a_step_may_be_called_as_what_is_said_of_states(system: ratn.System) -> None:
    run = system.run(measures)
    assert run.result(60).outputs == {"values": [1.5, 2.5]}, run.messages()


def test_a_worker_of_steps_that_cannot_be_started_again_ends_the_run(tmp_path: pathlib.Path) -> None:
    from ratn._system import Run, _OfSteps

    def start(*_: object) -> None:
        tries.append(time.monotonic())
        raise FileNotFoundError("resource-manager.endpoint")

    tries: list[float] = []
    run = Run.__new__(Run)
    run._process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    run._workers = [subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE) for _ in range(2)]
    run._workers[1] = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    run._of_steps = [_OfSteps(f"one-{n}", "one", f"{n}.py", tmp_path / f"{n}.log") for n in range(2)]
    run._lost, run._start_worker, run._abort_without_steps = "", start, run._process.terminate
    run._end_with_run(tmp_path)
    assert len(tries) == 3 and "resource-manager.endpoint" in run._lost, run._lost
    assert run._workers[1].wait(10) is not None, "those of other steps end with the run"


def test_a_run_whose_steps_have_a_worker_left_goes_on(tmp_path: pathlib.Path) -> None:
    from ratn._system import Run, _OfSteps

    run = Run.__new__(Run)
    run._process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(2)"])
    run._workers = [subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) for code in ("", "input()")]
    run._of_steps = [_OfSteps(f"one-{n}", "one", "one.py", tmp_path / f"{n}.log") for n in range(2)]
    run._lost, run._start_worker, run._abort_without_steps = "", lambda *_: None, run._process.terminate
    run._end_with_run(tmp_path)
    assert not run._lost and run._process.wait(0) == 0


def test_a_lease_of_a_manager_that_was_started_anew_is_not_alive(place: Place) -> None:
    config = place.write("system.toml", 'catalogues = ["built-in"]\n[process-manager]\nhost = "compute"\n')
    with place.up(config):
        system = ratn.System(runtime_dir=place.runtime)
        watch = system.watch("at(nothing)")
        lease = system.acquire("Camera", timeout_s=20)
        assert lease.alive and next(watch)["written"] == []
    with pytest.raises(ratn.Unavailable):
        system.query()
    with place.up(config):
        # The same object goes on with the new one.
        with system.acquire("Camera", timeout_s=20) as again:
            assert again.alive and not lease.alive and again.token > lease.token
        assert system.query("at(nothing)") == []
        assert lease.release() is False
        with pytest.raises(ratn.Unavailable):
            next(watch)
        system.close()


def test_python_goes_on_while_a_thread_waits_for_a_resource(system: ratn.System) -> None:
    with system.acquire("Camera"):
        got: list[ratn.Lease] = []
        waiting = threading.Thread(target=lambda: got.append(system.acquire("Camera", timeout_s=30)))
        waiting.start()
        time.sleep(0.2)
        assert not got
    waiting.join(30)
    assert got and got[0].release()


TWO_THREADS = """
import sys, threading, ratn

for _ in range(8):
    with ratn.System(runtime_dir=sys.argv[1]) as system:
        both = threading.Barrier(2)

        def hold(kind):
            both.wait()
            with system.acquire(kind, timeout_s=30):
                pass

        threads = [threading.Thread(target=hold, args=[kind]) for kind in ("Camera", "PanTilt")]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
print("both")
"""


def test_two_threads_open_the_session_of_a_system_together(system: ratn.System) -> None:
    told = subprocess.run([sys.executable, "-c", TWO_THREADS, str(system.runtime_dir)], capture_output=True, text=True, timeout=60)
    assert told.stdout == "both\n", told.stderr


FORK_OF_A_RUN = """
import asyncio, os, signal, sys, ratn

@ratn.task
def waits() -> None:
    ratn.wait(signal="go")

with ratn.System(runtime_dir=sys.argv[1]) as system:
    run, watch = system.run(waits), system.watch()
    assert next(watch) and run.id
    child = os.fork()
    if child == 0:
        signal.alarm(20)

        async def events():
            async for _ in run: ...

        for ask in (lambda: run.under_way, run.result, lambda: list(run), lambda: asyncio.run(events()), lambda: next(watch)):
            try:
                ask()
                os._exit(1)
            except ratn.Error as refused:
                if "is a fork" not in str(refused) or "spawn" not in str(refused):
                    os._exit(2)
        if "of another process" not in repr(run) or not run.id:
            os._exit(3)
        # The program speaks for itself.
        run.signal("go")
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert run.result(60).is_success
"""


def test_a_run_is_looked_at_in_no_fork_of_its_process(system: ratn.System) -> None:
    told = subprocess.run([sys.executable, "-c", FORK_OF_A_RUN, str(system.runtime_dir)], capture_output=True, text=True, timeout=60)
    assert told.returncode == 0, told.stderr


FORK = """
import os, signal, sys, ratn

with ratn.System(runtime_dir=sys.argv[1]) as system:
    lease = system.acquire("Camera")
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        for ask in (system.query, lambda: system.acquire("PanTilt"), lease.release):
            try:
                ask()
                os._exit(1)
            except ratn.Error as refused:
                if "is a fork" not in str(refused):
                    os._exit(2)
        system.close()
        del system, lease, ask
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert lease.alive and lease.release() and system.query() is not None
"""


def test_a_fork_of_a_process_neither_waits_for_its_threads_nor_ends_what_it_has(system: ratn.System) -> None:
    told = subprocess.run([sys.executable, "-c", FORK, str(system.runtime_dir)], capture_output=True, text=True, timeout=60)
    assert told.returncode == 0, told.stderr


@ratn.task
def orders() -> dict:
    order = ratn.wait(signal="order")
    return {"order": order.value}


@pytest.mark.parametrize(
    "value",
    [{"ü": 1, "a b": [1, {"x": None, "not": False}], "2": -2}, 'two "words"\n\t\r\\ü', "null", "find", "-x", -5, -(2**63), 1e300, 2**63 - 1, [], {}, [[{}]], False],
    ids=str,
)
def test_a_signal_has_any_value(system: ratn.System, value: object) -> None:
    run = system.run(orders)
    run.signal("order", value)
    got = run.result(60).outputs["order"]
    assert got == value and isinstance(got, bool) == isinstance(value, bool)


def test_a_value_that_is_none_is_refused_with_what_is_one(system: ratn.System) -> None:
    run = system.run(orders)
    for value, said in ((2**63, "64 bits"), (float("nan"), "finite"), (b"x", "a bytes is no value"), ("x\0", "NUL"), ("\ud800", "surrogate"), ("x" * 20_000, "10000")):
        with pytest.raises((ratn.Error, ValueError), match=said):
            run.signal("order", value)
    run.abort()
    run.result(60)


def test_a_time_to_wait_means_the_same_everywhere(system: ratn.System) -> None:
    run = system.run(orders)
    with system.acquire("Camera"):
        waits = (run.result, lambda timeout_s: system.acquire("Camera", timeout_s=timeout_s), lambda timeout_s: system.project({}, timeout_s=timeout_s))
        for wait in waits:
            for wrong in (float("nan"), -0.5, float("-inf")):
                with pytest.raises(ValueError, match="timeout_s is .*: say seconds, 0 or more, or None"):
                    wait(wrong)
    with pytest.raises(TimeoutError):
        run.result(0)
    run.signal("order")
    assert run.result(float("inf")).is_success
    for long in (float("inf"), 1e300):
        assert system.acquire("Camera", timeout_s=long).release()


def test_what_has_ended_says_so(system: ratn.System) -> None:
    run = system.run(orders)
    run.signal("order")
    run.result(60)
    for tell in (run.pause, run.abort, lambda: run.signal("order"), lambda: run.answer("yes")):
        with pytest.raises(ratn.Error, match="the run has ended"):
            tell()
    found = ratn.System(runtime_dir=system.runtime_dir)
    found.close()
    for ask in (found.query, found.resources, found.watch, found.pools, lambda: found.set("at(probe)", 1), lambda: found.acquire("Camera"), lambda: found.run(orders), lambda: found.project({})):
        with pytest.raises(ratn.Error, match="this system is closed"):
            ask()


WHO_RUNS_IT = """
import pathlib, sys, ratn

with ratn.System(pathlib.Path(sys.argv[1]), speed=50) as system:
    (pool,) = [pool for pool in system.pools() if pool["kind"] == "Late"]
    print(pathlib.Path(f"/proc/{pool['workers'][0]['pid']}/cmdline").read_bytes().split(b"\\0")[0].decode())
"""


@pytest.mark.skipif(sys.prefix == sys.base_prefix, reason="this interpreter is in no virtual environment")
def test_workers_are_run_by_the_environment_of_the_program_that_starts_them(place: Place) -> None:
    place.write("late.py", "import ratn\nworker = ratn.Worker()\n\n@worker.action\ndef late(goal: ratn.Goal) -> None: ...\n\nworker.run()\n")
    config = place.write(
        "system.toml",
        'catalogues = ["built-in"]\n[process-manager]\nhost = "compute"\n[[process-manager.template]]\nname = "late"\nkind = "Late"\npython = "late.py"\nmin = 1\n',
    )
    environment = {key: value for key, value in os.environ.items() if key not in ("VIRTUAL_ENV", "RATN_RUNTIME_DIR")}
    told = subprocess.run([sys.executable, "-c", WHO_RUNS_IT, str(config)], env=environment, capture_output=True, text=True, timeout=100)
    assert told.stdout.strip() == str(pathlib.Path(sys.prefix) / "bin" / "python"), told.stderr


def test_the_log_of_a_run_under_way_outlives_its_object(system: ratn.System) -> None:
    run = system.run(EXAMPLE, boxes=1)
    log, id = run.log, run.id
    process = run._process
    del run
    gc.collect()
    assert process.poll() is None and log.exists(), "the run writes into it"
    system_words = ["--runtime-dir", str(system.runtime_dir)]
    assert subprocess.run([program(), "control", "abort", "--run", id, *system_words]).returncode == 0
    process.wait(60)
    assert '"event":"ended"' in log.read_text() or log.read_text().count("\n") > 1
    shutil.rmtree(log.parent)
    # That of one that has ended goes with it.
    run = system.run(EXAMPLE, boxes=1)
    run.abort()
    run.result(60)
    log = run.log
    assert log.exists()
    del run
    gc.collect()
    assert not log.parent.exists()


def test_the_world_is_read_written_and_watched(system: ratn.System) -> None:
    seen: list[dict] = []
    watch = system.watch("at(probe)")
    assert next(watch)["written"] == []
    revision = system.set("at(probe)", ratn.Pose(1, 2, 3))
    (fact,) = system.query("at(probe)")
    assert (fact.predicate, fact.key, fact.value, fact.revision) == ("at", ("probe",), ratn.Pose(1, 2, 3), revision)
    seen.append(next(watch))
    assert seen[0]["revision"] == revision and seen[0]["written"][0].value == ratn.Pose(1, 2, 3)
    system.set("at(probe)", None)
    assert next(watch)["gone"] == ["at(probe)"] and system.query("at(probe)") == []


def test_a_projection_is_a_world_that_nobody_else_sees(system: ratn.System) -> None:
    system.set("at(probe)", ratn.Pose(1, 2, 3))
    with system.project({"at(probe)": ratn.Pose(4, 5, 6), "at(other)": ratn.Pose(), "on(probe, table)": None}, timeout_s=10) as world:
        assert [fact.value for fact in world.query("at(probe)")] == [ratn.Pose(4, 5, 6)]
        assert len(world.query("at(other)")) == 1 and {fact.predicate for fact in world.query()} >= {"at"}
        assert system.query("at(other)") == [] and system.query("at(probe)")[0].value == ratn.Pose(1, 2, 3)
        assert world.base > 0
    with pytest.raises(ratn.NotFound):
        world.query("at(probe)")
    # The room is given back.
    assert not any(resource["held"] for resource in system.resources("WorldModel"))
    with pytest.raises(ValueError, match="expected `predicate"):
        system.project({"at probe": None})
    system.set("at(probe)", None)


def test_errors_have_the_names_of_the_codes_and_say_what_to_do(system: ratn.System, tmp_path: pathlib.Path) -> None:
    with pytest.raises(ValueError, match="expected `predicate"):
        system.query("at box")
    with pytest.raises(ratn.Refused) as refused:
        system.set("on(a)", ratn.Trajectory([], []) if False else float("nan"))
    assert isinstance(refused.value, ratn.InvalidArgument) and refused.value.code == "INVALID_ARGUMENT"
    with pytest.raises(ratn.Unavailable, match="ratn up"):
        from ratn import _ratn

        _ratn.Client(tmp_path)


def test_a_system_that_runs_is_found(system: ratn.System) -> None:
    with ratn.System(runtime_dir=system.runtime_dir) as found:
        assert found.runtime_dir == system.runtime_dir and "started here" not in repr(found)
        assert {resource["id"] for resource in found.resources()} == {resource["id"] for resource in system.resources()}
    assert system.resources("Arm")


def test_the_tour_of_the_documentation_goes_through(place: Place) -> None:
    environment = {**os.environ, "RATN": program()}
    environment.pop("RATN_RUNTIME_DIR", None)
    command = [sys.executable, str(pathlib.Path(__file__).parent / "tour.py")]
    told = subprocess.run(command, env=environment, cwd=place.folder, capture_output=True, text=True, timeout=200)
    assert told.returncode == 0, told.stderr
    for part in ("Result(outcome='success'", "the longest was ", "<Lease ", "'camera@sim'", "box_1 ("):
        assert part in told.stdout, told.stdout
