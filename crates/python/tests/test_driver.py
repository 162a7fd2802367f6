"""A driver in Python: hold, emergency stop, standstill."""

from __future__ import annotations

import json
import pathlib
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator

import pytest
import ratn
from conftest import PYTHON, TESTS, Place, program, template

CONFIG = 'catalogues = ["built-in"]\n[process-manager]\nhost = "compute"\n'
TASK = (
    "task: moves\noutputs:\n  steps: { type: any, value: it.steps }\nstates:\n"
    "  - it: { action: mover/move, in: { steps: STEPS }, pia: true, effects: ['moved(mover)'], resources: [Mover] }\n"
)


@pytest.fixture(scope="module")
def mover() -> Iterator[Place]:
    with tempfile.TemporaryDirectory(prefix="ratn-py-") as folder:
        place = Place(pathlib.Path(folder))
        shutil.copy(TESTS / "workers" / "mover.py", folder)
        pool = template("mover", "Mover", python="mover.py", interpreter=PYTHON, min=1, max=1, standstill_ms=2000)
        with place.up(place.write("system.toml", CONFIG + pool), "--speed", "1"):
            yield place


def until(what: Callable[[], bool], place: Place, within_s: float = 30) -> None:
    end = time.monotonic() + within_s
    while not what():
        assert time.monotonic() < end, place.logs()
        time.sleep(0.02)


def begun(place: Place, steps: int, name: str) -> tuple[subprocess.Popen[str], pathlib.Path]:
    """A run of which the driver has begun to move."""
    log = place.folder / f"{name}.jsonl"
    task = place.write(f"{name}.yaml", TASK.replace("STEPS", str(steps)))
    command = [program(), "run", str(task), "--runtime-dir", str(place.runtime), "--log", str(log), "--json"]
    run = subprocess.Popen(command, env=place.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until(lambda: log.exists() and '"message":"moving"' in log.read_text(), place)
    return run, log


def safety(place: Place, *words: str) -> subprocess.CompletedProcess[str]:
    return place.ratn(*words, "--runtime-dir", place.runtime)


def test_a_hold_pauses_a_motion_which_then_goes_on(mover: Place) -> None:
    run, log = begun(mover, 150, "held")
    told = safety(mover, "hold")
    assert told.returncode == 0, told.stderr
    until(lambda: "brakes: held by the user" in mover.logs(), mover)
    steps = log.read_text().count('"message":"moving"')
    time.sleep(0.4)
    # One more may have been under way to the log.
    assert log.read_text().count('"message":"moving"') <= steps + 2 and run.poll() is None
    told = safety(mover, "go-on")
    assert told.returncode == 0, told.stderr
    said, errors = run.communicate(timeout=60)
    assert json.loads(said)["outcome"] == "success", errors


def test_an_emergency_stop_ends_the_goal_and_outlasts_the_driver(mover: Place) -> None:
    run, _ = begun(mover, 3000, "stopped")
    told = safety(mover, "stop")
    assert told.returncode == 0, told.stderr
    said, errors = run.communicate(timeout=60)
    assert json.loads(said)["outcome"] != "success", errors
    assert "brakes: stopped" in mover.logs()
    assert (mover.folder / "stop.json").exists()
    told = safety(mover, "stop", "--clear")
    assert told.returncode == 0, told.stderr
    assert not (mover.folder / "stop.json").exists()
    ended = mover.run(mover.write("after.yaml", TASK.replace("STEPS", "2")))
    assert ended["outcome"] == "success" and ended["outputs"]["steps"] == 2, ended


def test_the_brakes_of_a_pooled_driver_are_told_at_its_start(mover: Place) -> None:
    log = mover.logs()
    begun, let_go = log.find("brakes: held the driver has started"), log.find("brakes: ready")
    assert 0 <= begun < let_go, log
    assert 0 <= log.find("it is ready when its brakes have said that nothing moves"), "who waits for it reads why"
    assert log.find("brakes: held by the user") in (-1, *range(let_go, len(log)))


def test_a_pooled_driver_that_starts_while_it_is_stopped_is_told(place: Place) -> None:
    shutil.copy(TESTS / "workers" / "mover.py", place.folder)
    place.write("stop.json", "a test")
    pool = template("mover", "Mover", python="mover.py", interpreter=PYTHON, min=1, max=1, standstill_ms=2000)
    with place.up(place.write("system.toml", CONFIG + pool), "--speed", "1"):
        ended = place.run(place.write("stopped.yaml", TASK.replace("STEPS", "2")))
        assert ended["outcome"] != "success" and "a test" in ended["reason"], ended
        assert "brakes: stopped a test" in place.logs() and "brakes: ready" not in place.logs(), place.logs()
        assert safety(place, "stop", "--clear").returncode == 0
        until(lambda: "brakes: ready" in place.logs(), place)
        assert place.run(place.write("cleared.yaml", TASK.replace("STEPS", "2")))["outcome"] == "success"


def test_an_older_call_of_the_brakes_does_not_undo_a_stop(place: Place) -> None:
    shutil.copy(TESTS / "workers" / "slow_brakes.py", place.folder)
    pool = template("slow_brakes", "SlowBrakes", python="slow_brakes.py", interpreter=PYTHON, min=1, max=1, standstill_ms=2000)

    def said(line: str) -> int:
        return place.logs().count(line)

    with place.up(place.write("system.toml", CONFIG + pool), "--speed", "1"):
        before = said("brakes: ready begins")
        (place.folder / "slow").touch()
        assert safety(place, "hold").returncode == 0
        command = [program(), "go-on", "--runtime-dir", str(place.runtime)]
        going_on = subprocess.Popen(command, env=place.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(lambda: said("brakes: ready begins") == before + 1, place)
        told = safety(place, "stop")
        assert said("brakes: stopped done") >= 1, "the stop has not waited for the older call"
        assert told.returncode != 0, f"confirmed while the brakes may let go: {told.stdout}"
        (place.folder / "let_go").touch()
        going_on.wait(30)
        until(lambda: said("brakes: ready done") == before + 1, place)
        told = safety(place, "stop")
        assert told.returncode == 0, told.stdout + told.stderr
        assert (place.folder / "motor").read_text() == "stopped"


def test_brakes_that_an_older_call_keeps_from_stopping_stop_after_it(place: Place) -> None:
    shutil.copy(TESTS / "workers" / "slow_brakes.py", place.folder)
    (place.folder / "one_line").touch()
    pool = template("slow_brakes", "SlowBrakes", python="slow_brakes.py", interpreter=PYTHON, min=1, max=1, standstill_ms=2000)

    def said(line: str) -> int:
        return place.logs().count(line)

    with place.up(place.write("system.toml", CONFIG + pool), "--speed", "1"):
        before = said("brakes: ready begins")
        (place.folder / "slow").touch()
        assert safety(place, "hold").returncode == 0
        command = [program(), "go-on", "--runtime-dir", str(place.runtime)]
        going_on = subprocess.Popen(command, env=place.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(lambda: said("brakes: ready begins") == before + 1, place)
        told = safety(place, "stop")
        assert told.returncode != 0 and said("the line is busy") >= 1, told.stdout
        (place.folder / "let_go").touch()
        going_on.wait(30)
        # Nobody asks again.
        until(lambda: said("brakes: ready done") == before + 1 and said("brakes: stopped done") >= 1, place)
        assert (place.folder / "motor").read_text() == "stopped"
        told = safety(place, "stop")
        assert told.returncode == 0, told.stdout + told.stderr


def test_a_driver_without_brakes_or_without_leases_does_not_start() -> None:
    driver = ratn.Driver("mover")
    driver.action(lambda goal: {}, name="move", outputs={})
    with pytest.raises(ValueError, match="has no brakes"):
        driver.run([])
    with pytest.raises(ValueError, match="only for whoever holds it"):
        driver.run([], without_leases=True)

    async def later(state: str, reason: str) -> None: ...

    # Called, it would have done nothing.
    with pytest.raises(TypeError, match="the brakes are a plain function"):
        driver.brakes(later)


def test_brakes_that_have_done_nothing_confirm_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = ratn.Driver("mover")
    driver.action(lambda goal: {}, name="move", outputs={})

    async def later() -> None: ...

    driver.brakes(lambda state, reason: later())
    served: list[object] = []
    monkeypatch.setattr(ratn._ratn, "serve", lambda *given: served.append(given[-1]))
    driver.run([])
    with pytest.raises(TypeError, match="the brakes returned a coroutine"):
        served[0].brakes("stopped", "a test")  # type: ignore[attr-defined]


def test_a_pool_without_a_bound_for_standstill_refuses_the_driver(place: Place) -> None:
    shutil.copy(TESTS / "workers" / "mover.py", place.folder)
    pool = template("mover", "Mover", python="mover.py", interpreter=PYTHON, min=1, max=1, crash_limit=1)
    with pytest.raises(AssertionError, match="standstill_ms = 2000"):
        with place.up(place.write("system.toml", CONFIG + pool), "--speed", "1"):
            raise ValueError("it has started")
