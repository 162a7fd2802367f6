"""Workers in Python, in a real system."""

from __future__ import annotations

import copy
import json
import os
import pathlib
import pickle
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import ratn
from conftest import PYTHON, TESTS, Place, template

NO_CATALOGUE = 'catalogues = ["built-in"]\n[process-manager]\nhost = "compute"\n'


@pytest.fixture(scope="module")
def tester(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """A system with the workers of these tests, of which its catalogue knows nothing."""
    import tempfile

    with tempfile.TemporaryDirectory(prefix="ratn-py-") as folder:
        place = Place(pathlib.Path(folder))
        for name in ("tester.py", "nearest.py", "lingerer.py"):
            shutil.copy(TESTS / "workers" / name, folder)
        config = place.write(
            "system.toml",
            NO_CATALOGUE
            + template("tester", "Tester", python="tester.py", interpreter=PYTHON, max=2, min=1)
            + template("nearest", "Nearest", python="nearest.py", interpreter=PYTHON)
            + template("lingerer", "Lingerer", python="lingerer.py", interpreter=PYTHON),
        )
        with place.up(config, "--speed", "1"):
            yield place


def state(name: str, action: str, kind: str, inputs: str = "{}", more: str = "computes: true, reads: []") -> str:
    return f"  - {name}: {{ action: {action}, in: {inputs}, {more}, resources: [{kind}] }}\n"


def task(name: str, states: str, outputs: str = "") -> str:
    return f"task: {name}\n{outputs}states:\n{states}"


def performed(place: Place, name: str, action: str, inputs: str, output: str, kind: str = "any") -> object:
    text = task(name, state("it", f"tester/{action}", "Tester", inputs), f"outputs:\n  out: {{ type: {kind}, value: it.{output} }}\n")
    ended = place.run(place.write(f"{name}.yaml", text))
    assert ended["outcome"] == "success", f"{ended['reason']}\n{ended['stderr']}"
    return ended["outputs"]["out"]


def test_the_worker_of_fifteen_lines_reads_the_world_of_its_goal(tester: Place) -> None:
    assert len((TESTS / "workers" / "nearest.py").read_text().split("\n\n", 1)[1].strip().splitlines()) <= 15
    text = (
        "task: near\noutputs:\n  object: { type: any, value: it.object }\nworld:\n"
        '  - "at(cup) = pose(1, 0, 0)"\n  - "at(plate) = pose(0.2, 0, 0)"\nstates:\n'
        "  - it:\n      action: nearest/nearest\n      in: { start: 'pose(0.9, 0, 0)' }\n      computes: true\n"
        "      reads: ['at(?)']\n      resources: [Nearest, world_model]\n"
    )
    ended = tester.run(tester.write("near.yaml", text))
    assert ended["outcome"] == "success", ended["stderr"]
    assert ended["outputs"] == {"object": "cup"}
    assert '"message":"found"' in ended["log"]


def test_what_raises_aborted_is_the_reason_of_the_run(tester: Place) -> None:
    text = task("far", state("it", "nearest/nearest", "Nearest", "{ start: 'pose(900, 0, 0)', within_m: 0.5 }", "computes: true, reads: ['at(?)']"))
    ended = tester.run(tester.write("far.yaml", text.replace("[Nearest]", "[Nearest, world_model]")))
    assert ended["outcome"] == "aborted"
    assert "nothing so near" in ended["reason"], ended["reason"]


def test_a_worker_describes_itself(tester: Place) -> None:
    told = json.loads(tester.ratn("actions", "--runtime-dir", tester.runtime, "--json").stdout)
    text = json.dumps(told)
    assert "nearest" in text and "tester" in text, text
    shown = tester.ratn("actions", "nearest/nearest", "--runtime-dir", tester.runtime).stdout
    for part in ("The object nearest to a pose.", "start", "pose", "within_m", "9", "object"):
        assert part in shown, shown


def test_what_a_goal_sets_in_its_context_is_its_own(tester: Place) -> None:
    for given in (1, 2, 3, 4):
        assert performed(tester, f"context_{given}", "of_its_own", f"{{given: {given}}}", "before", "int") == 0


def test_arrays_of_numpy_come_and_go(tester: Place) -> None:
    assert performed(tester, "total", "add", "{ numbers: '[1, 2.5]' }", "total", "float") == 7.0
    assert performed(tester, "joints", "add", "{ numbers: '[1, 2.5]', factor: 1 }", "joints", "joints") == [1.0, 2.5]


@pytest.mark.parametrize("value", ["true", "3", "0.25", "'\"text\"'", "'[1, [2, null]]'", "'joints(0.5, 1)'"])
def test_every_kind_of_value_comes_back_as_it_was(tester: Place, value: str) -> None:
    expected = {"'\"text\"'": "text", "'[1, [2, null]]'": [1, [2, None]], "'joints(0.5, 1)'": [0.5, 1.0]}
    got = performed(tester, "echo", "echo", f"{{ value: {value} }}", "echo")
    assert got == expected.get(value, json.loads(value) if value not in expected else None)
    assert not isinstance(got, bool) or value == "true"


def test_what_an_action_says_of_itself_is_what_the_native_part_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = ratn.Worker("scanner")

    @worker.action(reads=[], effects=[], blocks=["Camera"], takes="0.5 * $rows")
    def scan(goal: ratn.Goal, rows: int) -> dict[str, int]:
        return {"rows": rows}

    @worker.action
    def other(goal: ratn.Goal) -> None: ...

    served: list[object] = []
    monkeypatch.setattr(ratn._ratn, "serve", lambda *given: served.append(given))
    worker.run([])
    scanned, unsaid = served[0][3]  # type: ignore[index]
    assert (scanned.reads, scanned.effects, scanned.blocks, scanned.takes) == ([], [], ["Camera"], "0.5 * $rows")
    assert (unsaid.reads, unsaid.effects, unsaid.blocks, unsaid.takes) == (None, None, [], None)
    # What is not said may move something.
    assert scanned.computes and not unsaid.computes


VALUES = [
    ratn.Pose(1, 2, 3, 0.1, 0.2, 0.3), ratn.Pose(-0.0), ratn.Pose(quaternion=(1, 1, 1, 3)), ratn.Joints([1, 2.5]), ratn.Joints([]),
    ratn.Trajectory(["a"], [(0, [1], [2]), (1, [3], [4])]), ratn.Trajectory(["a", "b"], [(0, [1, 2], [])]),
]


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_a_value_is_copied_pickled_and_a_key(value: ratn.Pose | ratn.Joints | ratn.Trajectory) -> None:
    for again in (copy.copy(value), copy.deepcopy(value), *(pickle.loads(pickle.dumps(value, protocol)) for protocol in range(2, 6))):
        assert again == value and hash(again) == hash(value) and {value: "there"}[again] == "there"
    assert len(set(VALUES)) == len(VALUES)
    assert hash(ratn.Pose(0.0)) == hash(ratn.Pose(-0.0))


def test_an_outcome_of_its_own_is_followed(tester: Place) -> None:
    text = (
        "task: odd\nstates:\n  - it:\n      action: tester/halve\n      in: { number: 7 }\n      computes: true\n      reads: []\n"
        "      resources: [Tester]\n      transitions: { odd: success }\n"
    )
    ended = tester.run(tester.write("odd.yaml", text))
    assert '"outcome":"odd"' in ended["log"], ended


def test_a_crash_is_in_the_reason_and_in_the_log_with_its_traceback(tester: Place) -> None:
    ended = tester.run(tester.write("crash.yaml", task("crash", state("it", "tester/crash", "Tester"))))
    assert ended["outcome"] == "aborted"
    for part in ("IndexError: list index out of range", "tester.py", 'return {"never": [][7]}'):
        assert part in ended["reason"], ended["reason"]
        assert part in tester.logs()
    assert "INFO tester: before the crash" in tester.logs()


@pytest.mark.parametrize(("action", "word"), [("nap", "woken"), ("wait", "cancelled")])
def test_a_goal_that_is_told_to_stop_ends_at_once(tester: Place, action: str, word: str) -> None:
    text = tester.write(f"{action}.yaml", task(action, state("it", f"tester/{action}", "Tester", "{ seconds: 60 }")))
    log = tester.folder / f"{action}.jsonl"
    from conftest import program

    command = [program(), "run", str(text), "--runtime-dir", str(tester.runtime), "--log", str(log), "--json"]
    run = subprocess.Popen(command, env=tester.environment, stdout=subprocess.PIPE, text=True)
    until = time.monotonic() + 30
    while not (log.exists() and '"note":"running"' in log.read_text()):
        assert time.monotonic() < until
        time.sleep(0.02)
    time.sleep(0.3)
    began = time.monotonic()
    assert tester.ratn("control", "abort", "--runtime-dir", tester.runtime).returncode == 0
    run.communicate(timeout=30)
    assert time.monotonic() - began < 10
    assert f"INFO tester: {word}" in tester.logs()


@pytest.mark.parametrize(
    ("action", "inputs", "reason"),
    [
        ("leave", "{ how: exit }", "SystemExit: no more of this"),
        ("leave", "{ how: interrupt }", "KeyboardInterrupt: by the action"),
        ("leave_later", "{}", "SystemExit: no more of that"),
    ],
)
def test_an_action_that_would_leave_the_process_is_aborted_and_the_worker_goes_on(tester: Place, action: str, inputs: str, reason: str) -> None:
    name = f"{action}_{len(inputs)}"
    ended = tester.run(tester.write(f"{name}.yaml", task(name, state("it", f"tester/{action}", "Tester", inputs))))
    assert ended["outcome"] == "aborted" and reason in ended["reason"], ended
    # Both processes of the pool, the one after the other.
    for number in range(4):
        assert performed(tester, f"after_{name}_{number}", "echo", "{ value: 3 }", "echo") == 3


@pytest.mark.parametrize(("how", "reason"), [("long", "ää\n…\nää"), ("unprintable", "Unprintable: "), ("group", "several (2 sub-exceptions)")])
def test_an_unusual_exception_is_a_reason_like_others(tester: Place, how: str, reason: str) -> None:
    if how == "group" and sys.version_info < (3, 11):
        pytest.skip("there are no groups of exceptions")
    ended = tester.run(tester.write(f"unusual_{how}.yaml", task(f"unusual_{how}", state("it", "tester/unusual", "Tester", f"{{ how: {how} }}"))))
    assert ended["outcome"] == "aborted" and reason in ended["reason"] and len(ended["reason"]) < 20_000, ended["reason"][:2_000]
    assert performed(tester, f"after_unusual_{how}", "echo", "{ value: 3 }", "echo") == 3


def test_a_goal_is_asked_in_no_fork_of_its_worker(tester: Place) -> None:
    text = task("asks", state("it", "tester/asks_in_a_fork", "Tester, world_model", more="computes: true, reads: ['at(?)']"), "outputs:\n  out: { type: any, value: it.refused }\n")
    ended = tester.run(tester.write("asks.yaml", text))
    refused = ended["outputs"]["out"]
    assert [said.split(":")[0] for said in refused] == [
        "cancelled", "checkpoint", "sleep", "while_held", "facts", "progress", "improved", "measured", "call", "on_cancel",
    ], ended
    assert all("is a fork" in said and 'multiprocessing.get_context("spawn")' in said for said in refused), refused


SERVE_IN_A_FORK = """
import os, sys, ratn

system = ratn.System(runtime_dir=sys.argv[1])
child = os.fork()
if child == 0:
    worker = ratn.Worker("late")

    @worker.action
    def late(goal: ratn.Goal) -> None: ...

    try:
        worker.run(["--id", "late", "--endpoint-file", sys.argv[1] + "/late.endpoint"])
    except ratn.Error as refused:
        os._exit(7 if "is a fork" in str(refused) else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_fork_of_a_process_with_a_system_is_no_worker(tester: Place) -> None:
    told = subprocess.run([sys.executable, "-c", SERVE_IN_A_FORK, str(tester.runtime)], capture_output=True, text=True, timeout=60)
    assert told.returncode == 7, told.stderr


def test_a_state_by_the_name_of_its_action_blocks_what_performs_it(tester: Place) -> None:
    from ratn._resources import of_system

    @ratn.task(world=["at(cup) = pose(1, 0, 0)", "at(plate) = pose(0.2, 0, 0)"])
    def near() -> dict:
        it = ratn.action("nearest/nearest", {"start": ratn.Pose(0.9)}, computes=True, reads=["at(?)"], name="it")
        with ratn.sequence("held", resources=["Nearest"], routine=True):
            ratn.action("nearest/nearest", {"start": ratn.Pose(0.9)}, effects=[], name="inside")
        return {"object": it.object}

    system = ratn.System(runtime_dir=tester.runtime)
    assert [found for found in near.check(system=system) if found.severity == "error"] == []
    document = near._knowing(lambda: of_system(tester.runtime)).document
    first, routine = document["states"]
    assert first["it"]["resources"] == ["Nearest", "world_model"] and "resources" not in routine["held"]["states"][0]["inside"], document
    assert "resources" not in near.document["states"][0]["it"]
    result = system.run(near).result(60)
    assert result.outputs == {"object": "cup"}, result

    @ratn.task
    def unknown() -> None:
        ratn.action("nearest/farthest")

    with pytest.raises(ratn.Error, match=r'nobody in the system offers the action `nearest/farthest`.*say `resources=\["Kind"\]`'):
        system.run(unknown)


def test_a_process_that_an_action_forks_leaves_the_goal_to_it(tester: Place) -> None:
    assert performed(tester, "forks", "forks", "{}", "codes") == [7, 0, 1]


def test_what_an_action_tells_of_its_progress_has_a_bound(tester: Place) -> None:
    assert performed(tester, "tells_little", "tell", "{ length: 4096 }", "refused") == ""
    ended = tester.run(tester.write("tells_often.yaml", task("tells_often", state("it", "tester/tell_often", "Tester", "{ times: 2000 }"))))
    assert ended["outcome"] == "success" and 0 < ended["log"].count('"message":"once more"') < 600, "100 at once, and 100 in a second"
    assert "at most 16384" in str(performed(tester, "tells_much", "tell", "{ length: 12000 }", "refused"))


def test_an_input_that_an_action_does_not_have_is_refused_with_those_that_it_has(tester: Place) -> None:
    text = task("asks", state("it", "tester/ask", "Tester, Nearest"), "outputs:\n  out: { type: any, value: it.heard }\n")
    ended = tester.run(tester.write("asks.yaml", text))
    assert ended["outcome"] == "success", ended
    assert "`begin`" in ended["outputs"]["out"] and "start, within_m" in ended["outputs"]["out"], ended


def test_a_call_of_another_provider_is_given_up_with_its_goal(tester: Place) -> None:
    text = task("through", state("it", "tester/through", "Tester, Lingerer", "{ seconds: 60 }", "computes: true, reads: [], timeout: 1"))
    ended = tester.run(tester.write("through.yaml", text), timeout=50)
    assert ended["outcome"] != "success" and ended["log"].count('"message":"calls"') == 1, ended
    assert "INFO tester: the call was given up" in tester.logs()


def test_what_a_group_of_tasks_raises_is_what_the_action_means(tester: Place) -> None:
    if sys.version_info < (3, 11):
        pytest.skip("there is no asyncio.TaskGroup")
    ended = tester.run(tester.write("together.yaml", task("together", state("it", "tester/together", "Tester"))))
    assert ended["outcome"] == "aborted" and "apart" in ended["reason"] and "Traceback" not in ended["reason"], ended["reason"]


def test_what_listens_to_a_goal_goes_with_it(tester: Place) -> None:
    seen = [performed(tester, f"watched_{number}", "watched", "{}", "watching", "int") for number in range(6)]
    assert max(seen) <= 1, f"{seen} are kept of goals that are over"


def test_what_listens_to_a_goal_is_not_called_after_its_end(tester: Place) -> None:
    text = task("deaf", state("it", "tester/deaf", "Tester", more="computes: true, reads: [], timeout: 0.5"))
    tester.run(tester.write("deaf.yaml", text))
    until = time.monotonic() + 20
    while "deaf: told to stop" not in tester.logs():
        assert time.monotonic() < until, tester.logs()
        time.sleep(0.05)
    time.sleep(1.5)
    assert "deaf: told when it was over" not in tester.logs(), tester.logs()


def test_outputs_of_an_outcome_and_arrays_that_may_be_left_out(tester: Place) -> None:
    assert performed(tester, "odd_joints", "odd", "{}", "joints", "joints") == [1.0, 2.5]
    assert performed(tester, "odd_none", "odd", "{}", "given", "bool") is False
    assert performed(tester, "odd_array", "odd", "{ numbers: '[1, 2]' }", "given", "bool") is True


def test_async_def_performs_goals_and_tells_how_far_it_is(tester: Place) -> None:
    assert performed(tester, "slept", "nap", "{ seconds: 0.05 }", "slept") == 0.05


def test_a_result_gets_better_until_it_is_used(tester: Place) -> None:
    paid = {}
    # What comes before the use ends when the price has been halved, however long the worker of the price takes to start. In the
    # sequential program nobody makes the file meanwhile.
    for mode, at_most_s in (("hsm", 0.1), ("cdtn", 60.0)):
        half = tester.folder / f"half_{mode}"
        states = (
            state("move", "tester/await_file", "Tester", f"{{ file: '\"{half}\"', at_most_s: {at_most_s} }}", "pia: true, effects: []")
            + state("price", "tester/price", "Tester", f"{{ item: cup, half_file: '\"{half}\"' }}", "description: 'it computes, as its action says'")
            + state("pay", "tester/pay", "Tester", "{ cost: price.cost }", "pia: true, effects: []")
        )
        outputs = "outputs:\n  paid: { type: int, value: pay.paid }\n  there: { type: bool, value: move.there }\n"
        ended = tester.run(tester.write(f"better_{mode}.yaml", task("better", states, outputs)), "--mode", mode)
        assert ended["outcome"] == "success", ended
        assert ended["outputs"]["there"] == (mode == "cdtn"), "the price got better while that before its use went on"
        paid[mode] = ended["outputs"]["paid"]
    assert paid["hsm"] == 100
    assert paid["cdtn"] < 90, "the use has what was the best then"


def test_which_interpreter_runs_a_script_is_said_and_what_is_missing_is_explained(place: Place) -> None:
    place.write("w.py", "")
    config = place.write("system.toml", NO_CATALOGUE + template("w", "W", python="w.py", interpreter=PYTHON))
    told = place.ratn("doctor", "--config", config, "--runtime-dir", place.runtime).stdout
    assert f"{PYTHON} runs it (the template's `interpreter`)" in told, told
    config = place.write("system.toml", NO_CATALOGUE + template("w", "W", python="none.py"))
    told = place.ratn("doctor", "--config", config, "--runtime-dir", place.runtime).stdout
    assert f"there is no Python script {place.folder / 'none.py'}" in told, told


def broken(function: object, **said: object) -> str:
    with pytest.raises(TypeError) as refused:
        ratn.Worker("broken").action(function, **said)  # type: ignore[arg-type]
    return str(refused.value)


def test_a_worker_reads_nothing_that_only_tasks_and_systems_need() -> None:
    program = """
import sys, ratn
w = ratn.Worker("bench")

@w.action
def add(goal: ratn.Goal, value: int) -> None: ...

print(*(module for module in ("asyncio", "numpy", "socket", "ssl", "subprocess", "tempfile", "ratn._system", "ratn._task") if module in sys.modules))

@w.action
async def wait(goal: ratn.Goal) -> None: ...

assert "asyncio" in sys.modules, "what its goals need is read before the first"
"""
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "\n"


def test_every_name_is_there_when_it_is_asked_for_and_no_other() -> None:
    program = """
import ratn
assert set(ratn.__all__) <= set(dir(ratn)) and "System" not in vars(ratn)
for name in ratn.__all__:
    assert getattr(ratn, name) is getattr(ratn, name)
from ratn import *
assert System is ratn.System and "System" in vars(ratn)
assert not hasattr(ratn, "asyncio")
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_what_is_no_port_is_refused_with_the_line_of_the_function() -> None:
    def complex_(goal: ratn.Goal, z: complex) -> dict:
        return {}

    def no_goal(x: int) -> dict:
        return {}

    def unseen(goal: ratn.Goal) -> dict:
        return dict(x=1)

    def many(goal: ratn.Goal, *numbers: int) -> dict:
        return {}

    def pieces(goal: ratn.Goal):
        yield {"piece": 1}

    for function, part in [(pieces, "without `yield`"), (complex_, "parameter `z`"), (no_goal, "is its goal"), (unseen, "outputs={"), (many, "`*numbers")]:
        said = broken(function)
        assert part in said and f"{__file__}:" in said, said


def test_a_pose_is_a_pose() -> None:
    import math

    turned = ratn.Pose(1, 2, 3, yaw=math.pi / 2)
    assert turned.position == (1, 2, 3) and turned.distance(ratn.Pose(1, 2, 0)) == 3
    x, y, z = turned.transform((1, 0, 0))
    assert (round(x, 9), round(y, 9), round(z, 9)) == (1, 3, 3)
    assert (turned @ turned.inverse()).distance(ratn.Pose()) < 1e-12
    assert math.isclose(turned.angle(ratn.Pose()), math.pi / 2)
    assert eval(repr(turned), {"Pose": ratn.Pose}) == turned
    with pytest.raises(ValueError, match="not both"):
        ratn.Pose(roll=1, quaternion=(0, 0, 0, 1))
    assert list(ratn.Joints([1, 2.5])) == [1.0, 2.5] and ratn.Joints([1])[-1] == 1


def test_joints_are_an_array_without_a_copy() -> None:
    import gc

    numpy = pytest.importorskip("numpy")
    joints = ratn.Joints([0.5, -1.0, 2.0])
    array = numpy.asarray(joints)
    assert array.dtype == float and array.tolist() == [0.5, -1.0, 2.0]
    assert array.ctypes.data == joints.__array_interface__["data"][0] and not array.flags.writeable
    # The array keeps what it is a view of.
    del joints
    gc.collect()
    assert array.sum() == 1.5
    assert numpy.asarray(ratn.Joints([])).shape == (0,)


def test_arrays_of_a_trajectory_share_its_memory_and_make_one() -> None:
    numpy = pytest.importorskip("numpy")
    positions = numpy.arange(6.0).reshape(3, 2)
    path = ratn.Trajectory(["a", "b"], times_s=[0, 1, 2.5], positions=positions, velocities=positions.T.reshape(3, 2))
    assert path.points[1] == (1.0, [2.0, 3.0], [4.0, 1.0]) and path.duration_s == 2.5
    assert path == ratn.Trajectory(["a", "b"], path.points)
    seen = numpy.asarray(path.positions)
    assert seen.shape == (3, 2) and (seen == positions).all() and numpy.asarray(path.times_s).tolist() == [0, 1, 2.5]
    assert seen.ctypes.data == path.positions.__array_interface__["data"][0]
    assert numpy.shares_memory(seen, numpy.asarray(path.positions))
    with pytest.raises(ValueError, match="read-only"):
        seen[0, 0] = 1
    # What is made of an array is its own: that may be written to afterwards.
    positions[:] = 9
    assert path.positions[0] == [0.0, 1.0] and seen[0, 1] == 1.0
    del path
    assert seen.sum() == 15
    with pytest.raises(ValueError, match="positions: 3 points of 2 joints"):
        ratn.Trajectory(["a", "b"], times_s=[0, 1, 2], positions=[[1, 2]], velocities=positions)
    with pytest.raises(TypeError, match="times_s"):
        ratn.Trajectory(["a", "b"], times_s=[0, 1, 2])
    still = ratn.Trajectory(["a", "b"], times_s=[0, 1, 2.5], positions=positions)
    assert still.velocities is None and still == ratn.Trajectory(["a", "b"], still.points)


def test_numbers_are_rows_and_need_no_numpy() -> None:
    path = ratn.Trajectory(["a", "b"], [(0, [1, 2], [0, 0]), (1, [3, 4], [0, 0])])
    numbers = path.positions
    assert len(numbers) == 2 and numbers[-1] == [3.0, 4.0] and list(numbers) == numbers.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert numbers.shape == (2, 2) and path.times_s.tolist() == [0.0, 1.0] and path.times_s[1] == 1.0
    assert numbers == path.positions and numbers != path.velocities
    assert repr(path.times_s) == "Numbers([0.0, 1.0])"
    with pytest.raises(IndexError):
        numbers[2]
    with pytest.raises((TypeError, ValueError)):
        ratn.Joints(["a", "b"])
    assert ratn.Joints(path.times_s) == ratn.Joints(range(2))


def test_numpy_looks_at_what_a_goal_has_where_it_lies(tester: Place) -> None:
    """Images, paths, joints and lists: the arrays own no memory, and nobody may write to them."""
    states = state("drawn", "tester/draw", "Tester") + state(
        "seen", "tester/see", "Tester", "{ picture: drawn.picture, rows: drawn.rows, path: drawn.path, numbers: '[1, 2]', joints: 'joints(1, 2)' }"
    )
    outputs = "outputs:\n  views: { type: any, value: seen.views }\n  sums: { type: any, value: seen.sums }\n"
    ended = tester.run(tester.write("views.yaml", task("views", states, outputs)))
    assert ended["outcome"] == "success", f"{ended['reason']}\n{ended['stderr']}"
    assert ended["outputs"]["views"] == dict.fromkeys(("joints", "numbers", "picture", "positions", "rows", "times_s", "velocities"), True)
    assert sorted(ended["outputs"]["sums"]) == sorted([255 * 128, 15, 3, 3, 3, 15, 7.5])


def test_a_covariance_is_a_matrix_where_the_fact_has_it(tester: Place) -> None:
    measured = "  - looked: { action: tester/look, senses: ['at(?)'], effects: ['at(ball) = pose(0, 0, 0)'], resources: [Tester] }\n"
    reads = state("sure", "tester/sure", "Tester", more="computes: true, reads: ['at(?)']").replace("[Tester]", "[Tester, world_model]")
    outputs = "outputs:\n  views: { type: any, value: sure.views }\n  covariance: { type: any, value: sure.covariance }\n"
    ended = tester.run(tester.write("sure.yaml", task("sure", measured + reads, outputs)))
    assert ended["outcome"] == "success", f"{ended['reason']}\n{ended['stderr']}"
    assert ended["outputs"] == {"views": [True] * 3, "covariance": [[0.25 * (row == column) for column in range(6)] for row in range(6)]}


def test_a_system_whose_worker_cannot_be_loaded_says_why_and_is_not_waited_for(place: Place) -> None:
    place.write("broken.py", "import ratn_has_no_such_module\n")
    config = place.write("system.toml", NO_CATALOGUE + template("broken", "Broken", python="broken.py", interpreter=PYTHON, crash_limit=2))
    with pytest.raises(ratn.Error) as raised:
        ratn.System(config, runtime_dir=place.runtime)
    assert "ModuleNotFoundError: No module named 'ratn_has_no_such_module'" in str(raised.value), raised.value
    assert "`broken` crash-loops: 2 crashes in a row" in str(raised.value), raised.value
    # All of its traceback is in the log.
    assert "Traceback" in place.logs()


STUBBORN = """
import time
import ratn

w = ratn.Worker("stubborn", kind="Stubborn")


@w.action(computes=True, reads=[])
def endless(goal: ratn.Goal) -> dict:
    while True:
        time.sleep(0.01)


@w.action(computes=True, reads=[])
def quick(goal: ratn.Goal) -> dict:
    return {}


w.run()
"""


def test_a_worker_that_does_not_stop_is_replaced(place: Place) -> None:
    place.write("stubborn.py", STUBBORN)
    pool = template("stubborn", "Stubborn", python="stubborn.py", interpreter=PYTHON, min=1, max=1, stuck_timeout_s=1)
    with place.up(place.write("system.toml", NO_CATALOGUE + pool), "--speed", "1"):
        more = "computes: true, reads: [], timeout: 0.5"
        endless = place.run(place.write("endless.yaml", task("endless", state("it", "stubborn/endless", "Stubborn", more=more))))
        assert endless["outcome"] == "aborted", endless
        quick = place.run(place.write("quick.yaml", task("quick", state("it", "stubborn/quick", "Stubborn"))))
        assert quick["outcome"] == "success", f"{quick['reason']}\n{place.logs()}"
        assert "of endless was told to stop 4 s ago, and still runs" in place.logs()


def test_a_task_is_checked_against_what_workers_say_of_themselves(tester: Place) -> None:
    @ratn.task
    def halves() -> dict:
        half = ratn.action("tester/halve", {"number": 8}, computes=True, reads=[], resources=["Tester"])
        return {"half": half.half}

    with pytest.raises(ratn.InvalidTask, match="unknown-provider"):
        halves.check()
    assert halves.check(system=tester.runtime) == []

    @ratn.task
    def wrong() -> None:
        ratn.action("tester/halve", {"nmber": 8}, computes=True, reads=[], resources=["Tester"])

    with pytest.raises(ratn.InvalidTask) as raised:
        wrong.check(system=tester.runtime)
    finding = next(finding for finding in raised.value.findings if finding.rule == "unknown-port")
    assert finding.file == __file__ and "number" in finding.help, finding
    with pytest.raises(ratn.Error, match="no system runs in"):
        halves.check(system=tester.folder / "nowhere")


def test_actions_of_a_running_system_are_a_module(tester: Place) -> None:
    import runpy

    import ratn._stubs

    robot = tester.folder / "robot.py"
    # Whatever the locale is.
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    told = subprocess.run(
        [sys.executable, "-m", "ratn", "stubs", "--runtime-dir", str(tester.runtime), str(robot)], capture_output=True, text=True, env=environment
    )
    assert told.returncode == 0, told.stderr
    module = runpy.run_path(str(robot))
    known = json.loads(ratn._ratn.catalogue([ratn._stubs.catalogue_of_system(tester.runtime)]))["providers"]["tester"]["actions"]
    assert known["watched"]["description"] == "Zählt, was auf frühere Ziele noch hört 🤖."
    assert known["watched"]["annotations"] == {"computes": True, "reads": []}, "what a worker says of its actions is known to tasks"
    assert known["look"]["annotations"] == {"computes": False, "senses": ["at(?)"]}, known["look"]
    assert known["add"]["defaults"] == {"factor": "2"}, known["add"]
    worker, arm = module["__getattr__"]("tester"), module["__getattr__"]("arm")

    @ratn.task
    def halves(number: int = 8) -> dict:
        arm.where()
        half = worker.halve(number=number, computes=True, reads=[])
        return {"half": half.half}

    assert halves.check() == [], "what the module says is known without the system"
    with ratn.System(runtime_dir=tester.runtime) as system:
        result = system.run(halves, number=10).result(60)
        assert result.is_success and result.outputs == {"half": 5}, result
    assert "def halve(" in robot.with_suffix(".pyi").read_text(encoding="utf-8")
