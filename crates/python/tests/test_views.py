"""What a run tells of itself, as records, texts and pictures."""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import ratn
from conftest import ROOT, program

LOG = ROOT / "crates" / "report" / "src" / "fixtures" / "two_boxes.jsonl"


@pytest.fixture(scope="module")
def log() -> ratn.Log:
    return ratn.Log(LOG)


def test_nodes_are_records_of_attempts(log: ratn.Log) -> None:
    nodes = log.nodes()
    assert [node["began_s"] for node in nodes] == sorted(node["began_s"] for node in nodes)
    outcomes = {node["outcome"] for node in nodes}
    # A worker that died, its second attempt, and a motion that failed.
    assert {"success", "crashed", "aborted"} <= outcomes, outcomes
    assert any(node["attempt"] == 2 for node in nodes)
    assert {"motion", "planning", "detection"} <= {node["activity"] for node in nodes}
    assert "<table>" in nodes._repr_html_() and nodes[0]["path"] in nodes._repr_html_()


def test_nodes_are_a_table_of_arrow_where_pyarrow_is_there(log: ratn.Log) -> None:
    if "pyarrow" not in sys.modules:
        try:
            import pyarrow  # noqa: F401
        except ImportError:
            with pytest.raises(ImportError, match="pip install pyarrow"):
                log.nodes().to_arrow()
            return
    table = log.nodes().to_arrow()
    assert table.num_rows == len(log.nodes()) and "path" in table.column_names


def test_why_says_what_waited_for_what(log: ratn.Log) -> None:
    why = log.why("fetch[1]/plan")
    assert len(why) == 1 and why[0]["path"] == "fetch[1]/plan"
    said = str(why)
    assert "asking for 10.10 s" in said and "path-planner-1@compute was held by fetch[0]/plan" in said, said
    assert "waiting for" in str(log.why("fetch[1]/move"))
    # By its last name, all visits.
    assert {visit["path"] for visit in log.why("plan")} >= {"fetch[1]/plan", "when_empty/plan"}
    with pytest.raises(ratn.NotFound, match="no state of the run is called `mvoe`.*fetch/move"):
        log.why("mvoe")


def test_the_critical_path_and_the_report_are_those_of_ratn_report(log: ratn.Log) -> None:
    path = log.critical_path()
    assert path[0]["from_s"] == pytest.approx(0) and all(a["to_s"] <= b["from_s"] + 1e-9 for a, b in zip(path, path[1:]))
    assert "look" in str(path).splitlines()[0] and "<table>" in path._repr_html_()
    report = log.report()
    told = subprocess.run([program(), "report", str(LOG)], capture_output=True, text=True, check=True)
    assert str(report).strip() == told.stdout.strip()
    assert report["critical_path"] == list(path) and "<pre>" in report._repr_html_()


def test_the_chart_is_that_of_ratn_report(log: ratn.Log, tmp_path: pathlib.Path) -> None:
    chart = log.gantt()
    assert chart._repr_svg_().startswith("<svg") and chart._repr_html_() == chart.svg
    chart.save(tmp_path / "mine.svg")
    subprocess.run([program(), "report", str(LOG), "--gantt", str(tmp_path / "its.svg")], capture_output=True, check=True)
    assert (tmp_path / "mine.svg").read_text() == (tmp_path / "its.svg").read_text()
    assert log.gantt("node").svg != chart.svg
    with pytest.raises(ValueError, match="expected `resource` or `node`"):
        log.gantt("colour")
    assert "<svg" in log._repr_html_() and "critical path" in log._repr_html_()


def test_a_log_that_is_none_is_refused_with_its_line(tmp_path: pathlib.Path) -> None:
    with pytest.raises(ratn.Error, match="never.jsonl"):
        ratn.Log(tmp_path / "never.jsonl")
    (tmp_path / "odd.jsonl").write_text('{"never": 1}\n')
    with pytest.raises(ratn.Error, match=r"odd.jsonl:1: not a line of an event log"):
        ratn.Log(tmp_path / "odd.jsonl")


@pytest.fixture(scope="module")
def system() -> Iterator[ratn.System]:
    os.environ["RATN"] = program()
    os.environ.pop("RATN_RUNTIME_DIR", None)
    with ratn.System(boxes=1, speed=50) as system:
        yield system


def test_a_task_of_python_runs_and_is_looked_at_as_it_was(system: ratn.System) -> None:
    from ratn.actions import gripper, pan_tilt

    @ratn.task
    def look_and_open(times: int = 1) -> dict:  # type: ignore[type-arg]
        """Looks, and opens the hand."""
        for i in ratn.each(ratn.fn.range(times)):
            pan_tilt.look_at(target=ratn.fn.pose(0.8, i * 0.1, 0.7), pia=True, effects=["pan_tilt_at(pan_tilt) = table"])
        open = gripper.release(pia=True, effects=["hand_empty(gripper)"])
        del open
        return {"times": times}

    assert look_and_open.check() == []
    run = system.run(look_and_open, times=2, seed=3)
    result = run.result(60)
    assert result.is_success and result.outputs == {"times": 2}, run.messages()
    assert [node["path"].rsplit("/")[-1] for node in run.nodes()] == ["look_at", "look_at", "open"] or len(run.nodes()) == 3
    assert "open (retired" in str(run.why("open"))
    assert run.critical_path() and run.report()["makespan_s"] == pytest.approx(result.makespan_s)
    assert "look_at" in run.gantt("node").svg and "<svg" in run._repr_html_()
    network = run.network()
    assert "look_at" in str(network) and network._repr_markdown_().startswith("```mermaid\n")


def test_a_run_is_sent_signals_and_answered(system: ratn.System) -> None:
    @ratn.task
    def hand_over() -> dict:  # type: ignore[type-arg]
        order = ratn.wait(signal="order")
        go_on = ratn.ask("May it open?", ["now", "never"])
        return {"order": order.value, "answer": go_on.answer}

    run = system.run(hand_over)
    end = time.monotonic() + 30
    while True:
        try:
            # It is refused as long as the run does not listen, and kept from then on.
            run.signal("order", {"boxes": [1, 2]})
            break
        except ratn.Error:
            assert time.monotonic() < end, run.messages()
            time.sleep(0.05)
    with pytest.raises(ratn.Error, match="nowhere"):
        run.signal("nowhere")
    while run.under_way:
        try:
            run.answer("now")
        except ratn.Error:
            assert time.monotonic() < end, run.messages()
            time.sleep(0.05)
    result = run.result(30)
    assert result.outputs == {"order": {"boxes": [1, 2]}, "answer": "now"}, run.messages()


def test_pools_are_shown(system: ratn.System) -> None:
    pools = system.pools()
    (planners,) = [pool for pool in pools if pool["kind"] == "PathPlanner"]
    assert planners["workers"] and planners["max"] >= 1 and planners["host"], planners


def test_steps_of_python_are_states_of_a_run(system: ratn.System, tmp_path: pathlib.Path) -> None:
    script = tmp_path / "choosing.py"
    script.write_text(
        "import ratn\n"
        "from ratn.actions import pan_tilt\n\n"
        "@ratn.step\n"
        "def heights(count: int, step_m: float = 0.1) -> dict:\n"
        "    return {'heights': [0.5 + step_m * i for i in range(count)]}\n\n"
        "@ratn.step(reads=['at(?)'], outputs={'found': 'int'})\n"
        "def found(goal: ratn.Goal) -> dict:\n"
        "    return {'found': len(goal.facts('at(?)'))}\n\n"
        "@ratn.task(world=['at(probe) = pose(1, 2, 3)'])\n"
        "def choosing(count: int = 2) -> dict:\n"
        "    chosen = heights(count=count)\n"
        "    for z in ratn.each(chosen.heights):\n"
        "        pan_tilt.look_at(target=ratn.fn.pose(0.8, 0, z), pia=True, effects=['pan_tilt_at(pan_tilt) = table'])\n"
        "    seen = found()\n"
        "    return {'heights': chosen.heights, 'found': seen.found}\n\n"
        "if __name__ == '__main__':\n"
        "    raise SystemExit('the worker of the steps ran the program')\n"
    )
    import runpy

    task = runpy.run_path(str(script), run_name="choosing")["choosing"]
    assert task.check() == []
    run = system.run(task, count=3, step_workers=2)
    result = run.result(90)
    assert result.is_success, f"{result}\n{run.messages()}"
    assert result.outputs["heights"] == pytest.approx([0.5, 0.6, 0.7]) and result.outputs["found"] >= 1
    # The workers end with the run.
    end = time.monotonic() + 30
    while any(resource["kind"].startswith("ChoosingSteps") for resource in system.resources()):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_the_steps_of_a_run_are_done_by_its_own_workers(system: ratn.System, tmp_path: pathlib.Path) -> None:
    import runpy

    (tmp_path / "other").mkdir()
    step = "import os\nimport ratn\n\n@ratn.step(reads=[])\ndef who(of: int = 0) -> dict:\n    return {'pid': os.getpid(), 'file': __file__}\n"
    (tmp_path / "other" / "whose.py").write_text(step)
    script = tmp_path / "whose.py"
    script.write_text(
        step + "\nimport importlib.util\nspec = importlib.util.spec_from_file_location('whose_other', os.path.join(os.path.dirname(__file__), 'other', 'whose.py'))\n"
        "other = importlib.util.module_from_spec(spec)\nspec.loader.exec_module(other)\n\n"
        "@ratn.task\ndef whose() -> dict:\n"
        "    for i in ratn.each(ratn.fn.range(12)):\n        one = who(of=i)\n        pids = ratn.collect(one.pid)\n        files = ratn.collect(one.file)\n"
        "    second = other.who(of=1)\n    return {'pids': pids, 'files': files, 'other': second.file, 'other_pid': second.pid}\n"
    )
    task = runpy.run_path(str(script), run_name="whose")["whose"]
    assert task.check() == []
    runs = [system.run(task) for _ in range(2)]
    for run in runs:
        result = run.result(90)
        assert result.is_success, f"{result}\n{run.messages()}"
        own = [worker.pid for worker in run._workers]
        assert {*result.outputs["pids"], result.outputs["other_pid"]} == {*own}, f"{result.outputs} of workers {own}"
        assert {*result.outputs["files"]} == {str(script)} and result.outputs["other"] == str(tmp_path / "other" / "whose.py")


def test_a_step_that_says_nothing_may_do_anything_and_one_that_says_what_it_reads_computes(tmp_path: pathlib.Path) -> None:
    import runpy

    script = tmp_path / "said.py"
    script.write_text(
        "import ratn\n\n@ratn.step\ndef plain() -> None: ...\n\n@ratn.step(reads=[])\ndef looks_at_nothing() -> None: ...\n\n"
        "@ratn.step(computes=True)\ndef works() -> None: ...\n\n@ratn.step(effects=['done()'])\ndef does() -> None: ...\n\n"
        "@ratn.task\ndef said() -> None:\n    plain()\n    looks_at_nothing()\n    works()\n    does()\n"
    )
    states = runpy.run_path(str(script), run_name="said")["said"].document["states"]
    said = {name: {key: state[key] for key in ("computes", "reads", "effects") if key in state} for one in states for name, state in one.items()}
    computes = {"computes": True, "reads": []}
    assert said == {"plain": {}, "looks_at_nothing": computes, "works": computes, "does": {"effects": ["done()"]}}, said


def test_a_worker_of_steps_that_dies_is_replaced_and_not_for_ever(system: ratn.System, tmp_path: pathlib.Path) -> None:
    import runpy

    script = tmp_path / "dying.py"
    script.write_text(
        "import os, pathlib, ratn\n\n@ratn.step(reads=[])\ndef die(times: int) -> dict:\n    died = pathlib.Path(__file__).with_suffix(f'.{times}')\n"
        "    before = len(died.read_text()) if died.exists() else 0\n    if before < times:\n        died.write_text('x' * (before + 1))\n        os._exit(3)\n"
        "    return {'before': before}\n\n"
        "@ratn.task\ndef dying(times: int = 1) -> dict:\n    it = die(times=times)\n    return {'before': it.before}\n"
    )
    task = runpy.run_path(str(script), run_name="dying")["dying"]
    result = system.run(task, times=1).result(60)
    assert result.is_success and result.outputs == {"before": 1}, result
    result = system.run(task, times=100).result(60)
    assert not result.is_success, result


def test_a_step_whose_file_does_not_load_is_told(system: ratn.System, tmp_path: pathlib.Path) -> None:
    script = tmp_path / "odd.py"
    good = "import ratn\n\n@ratn.step\ndef one() -> dict:\n    return {'a': 1}\n\n@ratn.task\ndef odd() -> None:\n    one()\n"
    script.write_text(good)
    import runpy

    task = runpy.run_path(str(script), run_name="odd")["odd"]
    script.write_text(good + "\nif __name__ == '__ratn_steps__':\n    raise OSError('no camera')\n")
    with pytest.raises(ratn.Error, match="no camera"):
        system.run(task)


def test_a_program_that_would_start_itself_again_is_told_what_to_write(system: ratn.System, tmp_path: pathlib.Path) -> None:
    script = tmp_path / "unguarded.py"
    script.write_text(
        "import ratn\n\n@ratn.step\ndef one() -> dict:\n    return {'a': 1}\n\n@ratn.task\ndef unguarded() -> None:\n    one()\n\n"
        "if __name__ != 'told':\n    ratn.System().run(unguarded).result()\n"
    )
    import runpy

    task = runpy.run_path(str(script), run_name="told")["unguarded"]
    with pytest.raises(ratn.Error, match='unguarded.py is being read by the worker of its steps.*if __name__ == "__main__":'):
        system.run(task)


def test_a_system_ends_with_the_process_that_started_it(tmp_path: pathlib.Path) -> None:
    """Also where that was killed."""
    script = "import os, sys, time, ratn\ns = ratn.System(boxes=1, speed=20)\nprint(s._process.pid, flush=True)\ntime.sleep(600)\n"
    environment = {**os.environ, "RATN": program()}
    environment.pop("RATN_RUNTIME_DIR", None)
    parent = subprocess.Popen([sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    system = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    end = time.monotonic() + 15
    while True:
        try:
            # It may be a zombie of whoever adopted it.
            if pathlib.Path(f"/proc/{system}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                break
        except FileNotFoundError:
            break
        assert time.monotonic() < end, "`ratn up` outlives the process that started it"
        time.sleep(0.05)
