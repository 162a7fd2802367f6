"""Tasks in Python: traced into the same model as a task file, and refused with the line of the user's file."""

from __future__ import annotations

import inspect
import json
import pathlib
import re
import subprocess
import sys
import typing
from collections.abc import Callable, Iterator

import pytest
import ratn
from conftest import ROOT
from ratn import Task, fn
from ratn.actions import arm, detector, gripper, pan_tilt, path_planner

TABLE = ratn.Pose(0.8, 0, 0.7)
REGION = {"pose": TABLE, "size": [0.6, 1.2]}


def files_with_tasks() -> list[pathlib.Path]:
    return [*sorted((ROOT / "examples").glob("*.yaml")), *sorted((ROOT / "crates").glob("trials/tests/**/*.yaml"))]


def blocks() -> Iterator[str]:
    """The tasks of the reference of task files."""
    text = (ROOT / "docs" / "task-files.md").read_text()
    yield from re.findall(r"^```yaml\n(.*?)^```", text, re.M | re.S)


def traced(source: str, name: str = "traced.py") -> Task:
    """The task of a module's text, which is known to Python as that of a file is."""
    import linecache

    linecache.cache[name] = (len(source), None, source.splitlines(True), name)
    module: dict[str, object] = {"__name__": "traced"}
    exec(compile(source, name, "exec"), module)
    (task,) = [value for value in module.values() if isinstance(value, Task)]
    return task


def same(one: Task, other: Task) -> None:
    assert other.model() == one.model()


@pytest.mark.parametrize("file", files_with_tasks(), ids=lambda file: file.stem)
def test_a_task_file_goes_to_python_and_back_without_loss(file: pathlib.Path) -> None:
    task = Task.from_yaml(file)
    again = Task.from_yaml(task.to_yaml())
    assert again.document == task.document
    again.folder = task.folder
    same(task, again)
    python = traced(task.to_python())
    python.folder = task.folder
    same(task, python)


@pytest.mark.parametrize("text", list(blocks()), ids=lambda text: text.split()[1])
def test_every_task_of_the_reference_goes_to_python_and_back_without_loss(text: str) -> None:
    task = Task.from_yaml(text)
    same(task, Task.from_yaml(task.to_yaml()))
    same(task, traced(task.to_python()))


def test_a_function_is_the_task_that_yaml_says_it_is() -> None:
    class Visited(typing.TypedDict):
        visited: int

    observation = ratn.Joints([0.9, -1.2, 0, 0.9, 0, -0.6, 0])

    @ratn.task(world=["at(base) = pose(0, 0, 0)", "at(table) = pose(0.80, 0, 0.675)", "shape(table) = {type: box, size: [0.60, 1.20, 0.05]}"])
    def visit_boxes(
        most: typing.Annotated[int, ratn.Doc("how many boxes to visit")] = 2, observation: ratn.Joints = observation
    ) -> Visited:
        tuck = arm.move_to(joints=observation, pia=True, effects=["posture(arm) = observation"], resources=[ratn.block("Arm")])
        aim = pan_tilt.look_at(target=TABLE, pia=True, effects=["pan_tilt_at(pan_tilt) = table"], resources=[ratn.block("PanTilt")])
        look = detector.segment(
            region={"pose": TABLE, "size": [0.6, 1.2]},
            senses=["pan_tilt_at(pan_tilt)", "posture(arm)"],
            requires=["posture(arm) = observation"],
            effects=[{"for": "b in boxes", "do": ["at($b.id) = $b.pose", "shape($b.id) = {type: box, size: $b.size}"]}],
            resources=[ratn.block("Detector"), ratn.block("Camera")],
        )
        planned = {"computes": True, "reads": ["scene"], "duration": 6.0, "resources": [ratn.block("PathPlanner"), "world_model"]}
        moved = {"pia": True, "resources": [ratn.block("Arm")]}
        for box in ratn.each(fn.take(look.boxes, most)):
            above = {"pose": fn.compose(box.pose, ratn.Pose(0, 0, 0.15)), "size": box.size}
            plan_there = path_planner.plan(start=observation, goal=fn.grasp_pose(above), budget_s=6.0, **planned)
            go_there = arm.follow(trajectory=plan_there.trajectory, effects=["posture(arm) = at_work"], **moved)
            plan_back = path_planner.plan(start=plan_there.end, goal=observation, budget_s=6.0, **planned)
            go_back = arm.follow(trajectory=plan_back.trajectory, effects=["posture(arm) = observation"], **moved)
            assert [tuck, aim, go_there, go_back]
        return {"visited": fn.len(fn.take(look.boxes, most))}

    (text,) = [text for text in blocks() if text.startswith("task: visit_boxes")]
    same(Task.from_yaml(text), visit_boxes)
    assert visit_boxes.check() == []
    assert visit_boxes.parameters["most"] == {"type": "int", "default": 2, "description": "how many boxes to visit"}


def test_what_different_ways_give_is_put_out_by_the_block_around_them() -> None:
    @ratn.task
    def ways(n: int = 1) -> dict[str, ratn.Value]:
        with ratn.when(n > 1) as near:
            look = detector.segment(region=REGION)
            other = pan_tilt.look_at(target=TABLE)
        with ratn.otherwise():
            again = detector.segment(region=REGION)
        for box in ratn.each(fn.either(look.boxes, again.boxes)):
            plan = path_planner.plan(start=ratn.Joints([0] * 7), goal=box.pose)
            trajectories = ratn.collect(plan.trajectory)
            with ratn.when(n > 3):
                one = pan_tilt.look_at(target=box.pose)
            ratn.collect(fn.either(one.pan, 0), name="pans", type="list<float>")
        for way in ratn.each(trajectories):
            arm.follow(trajectory=way)
        with ratn.concurrently("preemptive"):
            head = pan_tilt.look_at(target=TABLE)
            gripper.release()
        near.outputs(panned=ratn.output(other.pan, default=0.5))
        pan_tilt.look_at(target=fn.pose(0.1, fn.either(head.pan, 0.5), near.panned), name="last")
        return {"length_m": fn.either(plan.length_m, 0)}

    near, loop, follow, race, last = ways.document["states"]
    assert near["near"]["outputs"] == {"boxes": "either(look.boxes, again.boxes)", "panned": {"value": "other.pan", "default": 0.5}}
    assert loop["for_box"]["for"] == "box in near.boxes"
    assert loop["for_box"]["outputs"] == {
        "trajectories": {"each": "plan.trajectory"},
        "pans": {"each": "either(condition_2.pan, 0)", "type": "list<float>"},
        "length_m": "either(plan.length_m, 0)",
    }
    assert loop["for_box"]["do"][1]["condition_2"]["outputs"] == {"pan": "either(one.pan, 0)"}
    assert follow["for"] == "way in for_box.trajectories"
    assert race["concurrently"]["outputs"] == {"pan": "either(head.pan, 0.5)"}
    assert last["last"]["in"]["target"] == "pose(0.1, either(concurrently.pan, 0.5), near.panned)"
    assert ways.document["outputs"] == {"length_m": "either(for_box.length_m, 0)"}
    assert "ratn.output(each=expr('plan.trajectory'))" in ways.to_python()
    with pytest.raises(TypeError, match="an output has a value"):
        ratn.output()


def test_what_is_beside_a_block_and_inside_of_it_keeps_its_order() -> None:
    @ratn.task
    def ways(n: int = 1) -> None:
        first = pan_tilt.look_at(target=TABLE, name="first")
        with ratn.when(n > 1):
            again = pan_tilt.look_at(target=TABLE, name="again")
        pan_tilt.look_at(target=fn.pose(fn.either(again.pan, first.pan, 0), 0, 1), name="newest")
        pan_tilt.look_at(target=fn.pose(fn.either(first.tilt, again.tilt), 0, 1), name="oldest")
        last = pan_tilt.look_at(target=fn.pose(fn.either(again.pan, 1), 0, 1), name="last")
        pan_tilt.look_at(target=fn.pose(fn.either(last.pan, again.pan, first.pan), 0, 1), name="behind")

    _, block, newest, oldest, _, behind = ways.document["states"]
    assert block["condition_2"]["outputs"] == {
        "pan": "either(again.pan, first.pan, 0)",
        "tilt": "either(first.tilt, again.tilt)",
        "either_pan": "either(again.pan, 1)",
        "either_pan_3": "either(again.pan, first.pan)",
    }
    assert newest["newest"]["in"]["target"] == "pose(either(condition_2.pan, first.pan, 0), 0, 1)"
    assert oldest["oldest"]["in"]["target"] == "pose(either(condition_2.tilt, first.tilt), 0, 1)"
    assert behind["behind"]["in"]["target"] == "pose(either(last.pan, condition_2.either_pan_3, first.pan), 0, 1)"

    def behind_the_block(n: int = 1) -> None:
        with ratn.when(n > 1):
            again = pan_tilt.look_at(target=TABLE, name="again")
        last = pan_tilt.look_at(target=TABLE, name="last")
        pan_tilt.look_at(target=fn.pose(fn.either(again.pan, last.pan), 0, 1))

    message, _ = refused(behind_the_block)
    assert "before one from a state behind it" in message


def test_nothing_is_collected_outside_of_a_loop() -> None:
    def outside() -> None:
        look = detector.segment(region=REGION)
        ratn.collect(look.boxes)

    message, line = refused(outside)
    assert (message.partition(":")[0], line) == ("`ratn.collect` outside of a loop", 2)


def test_a_block_that_is_tried_again_shows_its_states_to_what_comes_after() -> None:
    @ratn.task
    def again() -> None:
        with ratn.retry(3, backoff=0.5):
            grasp = gripper.grasp(object="cup", pia=True)
        with ratn.retry(2, on=["aborted"]) as find:
            with find.before():
                gripper.release(name="open")
            pan_tilt.look_at(target=TABLE)
            look = detector.segment(region=REGION, resources=["Detector", "Camera"])
        pan_tilt.look_at(target=fn.pose(0.8, grasp.width_m, 0.7))
        for box in ratn.each(look.boxes):
            pan_tilt.look_at(target=box.pose)

    states = again.document["states"]
    # One action in the block: the action is tried again. Several: they are a state.
    assert states[0]["grasp"]["retry"] == {"times": 3, "backoff": 0.5}
    assert states[1]["find"]["outputs"] == {"boxes": "look.boxes"}
    assert [*states[1]["find"]["retry"]["before"][0]] == ["open"]
    assert states[3]["for"] == "box in find.boxes"
    again.check()


def test_every_form_of_a_state_is_traced() -> None:
    @ratn.task(outcomes=["none"], exceptions="imprecise", horizon=60)
    def forms(count: int) -> None:
        """All of them."""
        tries = ratn.variable(0)
        look = detector.segment(region=REGION, resources=["Detector", "Camera"], out={"boxes": {"default": []}})
        with ratn.when((fn.len(look.boxes) > 0) & ~ratn.exists(ratn.fact("in_gripper", "cup")) | (count < 2), outcomes=["empty"], transitions={"empty": "none"}):
            with ratn.sequence("held", routine=True, resources=["Arm"], timeout=20):
                gripper.release(holds=[ratn.fact("closed", "door")])
            with ratn.lastly():
                gripper.release()
        with ratn.otherwise():
            ratn.leave("empty")
        with ratn.lastly():
            pan_tilt.look_at(target=TABLE)
        with ratn.while_(tries < 3) as loop:
            pan_tilt.look_at(target=fn.pose(0.8, loop.index * 0.1, 0.7), assign={"tries": tries + 1})
        with ratn.until() as seen:
            again = detector.segment(region=REGION, resources=["Detector", "Camera"])
            seen.test(fn.len(again.boxes) > 1)
        with ratn.concurrently("barrier") as both:
            hand = gripper.release(reads=[], effects=["hand_empty(gripper)"])
            head = pan_tilt.look_at(target=TABLE, reads=[], effects=["pan_tilt_at(pan_tilt) = table"])
            both.decide(blind=(head.outcome == "aborted") & (hand.outcome == "success"))
        both._node.body["transitions"] = {"blind": "success"}
        for i, box in ratn.each(fn.sort_by(look.boxes, lambda b: b.size[0]), index=True):
            pan_tilt.look_at(target=box.pose, requires=[f"{i} < 9", ratn.isin("cup", ["cup", "mug"])])

    written = forms.to_yaml()
    for part in (
        "condition: \"((len(look.boxes) > 0) and (not (exists in_gripper(cup)))) or ($count < 2)\"",
        "target: \"pose(0.8, $iteration * 0.1, 0.7)\"",
        "until: \"len(again.boxes) > 1\"",
        "while: [\"closed(door)\"]",
        "timeout: 20",
        "finally:",
        "for: \"box in sort_by($b in look.boxes, $b.size[0])\"",
        "requires: [\"$i < 9\", \"cup in [cup, mug]\"]",
        "description: \"All of them.\"",
    ):
        assert part in written, written
    same(forms, Task.from_yaml(written))


def refused(function: Callable[..., object]) -> tuple[str, int]:
    with pytest.raises(ratn.Untraceable) as wrong:
        ratn.task(function)
    said = str(wrong.value)
    place, _, message = said.partition(": ")
    file, _, line = place.rpartition(":")
    assert file == __file__, said
    return message, int(line) - function.__code__.co_firstlineno


def test_what_cannot_be_traced_is_refused_with_its_line_and_what_to_write_instead() -> None:
    def if_(n: int) -> None:
        gripper.release()
        if n > 3:
            gripper.release()

    def while_(n: int) -> None:
        while n > 3:
            gripper.release()

    def and_(n: int) -> None:
        print((n > 1)
              and n < 3)

    def not_(n: int) -> None:
        print(not n)

    def chained(n: int) -> None:
        print(1 < n < 3)

    def ternary(n: int) -> None:
        print(1 if n else 2)

    def in_(n: list) -> None:
        print(3 in n)

    def for_(n: list) -> None:
        for _ in n:
            gripper.release()

    def range_(n: int) -> None:
        for _ in range(n):
            gripper.release()

    def comprehension(n: list) -> None:
        print([x for x in n])

    def filtered(n: int) -> None:
        print([x for x in [1] if n])

    def length(n: list) -> None:
        print(len(n))

    def whole(n: int) -> None:
        print(int(n))

    def posed(n: int) -> None:
        print(ratn.Pose(1, n, 2))

    def key(n: int) -> None:
        print({n: 1})

    def asserted(n: int) -> None:
        assert n

    def state(n: int) -> None:
        if gripper.release():
            pass

    def broken(n: list) -> None:
        for _ in ratn.each(n):
            break

    def listed(n: list) -> None:
        print(list(ratn.each(n)))

    def alone(n: int) -> None:
        with ratn.otherwise():
            pass

    def unnamed(n: int) -> None:
        print(ratn.variable(0))

    def returned(n: int) -> object:
        with ratn.when(n > 2):
            return {"early": "yes"}
        gripper.release()
        return {"early": "no"}

    def skipped(n: list) -> None:
        for one in ratn.each(n):
            with ratn.when(one > 2):
                if True:
                    continue
            gripper.release()

    def left(n: int) -> None:
        for _ in (1, 2, 3):
            with ratn.when(n > 2):
                gripper.release()
            with ratn.otherwise():
                break
            gripper.release()

    def endless(n: int) -> None:
        ratn.wait(seconds=1)
        ratn.wait(signal="go", timeout=float("inf"))

    def handled(n: int) -> None:
        try:
            gripper.release()
        except (ValueError, ratn.Aborted):
            gripper.grasp("cup")

    expected = {
        returned: ("this `return` leaves a block that is done only sometimes", 2), skipped: ("this `continue`", 4), left: ("this `break`", 5),
        handled: ("`except ratn.Aborted` around a state", 3), endless: ("inf is no number of a task", 2),
        if_: ("with ratn.when(condition)", 2), while_: ("with ratn.while_(condition)", 1), and_: ("`(a) & (b)`", 1), not_: ("`~(a)`", 1),
        chained: ("(a < b) & (b < c)", 1), ternary: ("fn.if_(", 1), in_: ("ratn.isin(", 1), for_: ("for x in ratn.each(list)", 1),
        range_: ("ratn.each(fn.range(n))", 1), comprehension: ("fn.map(", 1), filtered: ("fn.filter(", 1), length: ("fn.len(", 1), whole: ("fn.floor", 1),
        posed: ("fn.pose(", 1), key: ("known now", 1), asserted: ("requires=[", 1), state: ("transitions=", 1), broken: ("`break`", 1),
        listed: ("outside of a `for`", 1), alone: ("right behind", 1), unnamed: ("tries = ratn.variable(0)", 1),
    }
    for function, (part, line) in expected.items():
        message, said = refused(function)
        assert part in message and said == line, f"{function.__name__}: line {said}: {message}"


def test_what_is_left_as_in_python_is_traced() -> None:
    @ratn.task
    def left(n: int) -> object:
        with ratn.when(n > 2):
            for number in (1, 2, 3):
                if number == 2:
                    break
                gripper.release(name=f"release_{number}")

            def never() -> int:
                return 1
        try:
            gripper.release(name="again")
        except ValueError:
            pass
        with ratn.retry(2):
            gripper.release(name="last")
            return {"n": n}

    written = left.to_yaml()
    assert [name in written for name in ("release_1", "release_2", "again", "last")] == [True, False, True, True], written


def test_a_call_outside_of_a_task_and_a_wrong_port_are_refused() -> None:
    with pytest.raises(ratn.Untraceable, match="belongs into a task"):
        gripper.release()
    with pytest.raises(AttributeError, match="`gripper` has no action `open`; it has feel, grasp"):
        gripper.open  # noqa: B018
    with pytest.raises(AttributeError, match="no function `lenght`"):
        fn.lenght  # noqa: B018

    def wrong() -> None:
        gripper.grasp(thing="cup")

    with pytest.raises(TypeError, match="`gripper.grasp` has no input `thing`; it has arm, expected, hand, object"):
        ratn.task(wrong)


def test_findings_name_the_line_of_the_python_file() -> None:
    @ratn.task
    def wrong() -> None:
        gripper.release()
        pan_tilt.look_at(target="table",
                         effects={"never": []})

    begins = inspect.getsourcelines(test_findings_name_the_line_of_the_python_file)[1]
    with pytest.raises(ratn.InvalidTask) as raised:
        wrong.check()
    rules = {finding.rule: finding for finding in raised.value.findings}
    assert {"unknown-outcome", "type-mismatch"} <= rules.keys(), str(raised.value)
    assert {(finding.file, finding.line) for finding in rules.values()} == {(__file__, begins + 4)}, str(raised.value)
    assert "help: " in str(raised.value) and f"{__file__}:{begins + 4}: error[" in str(raised.value)


def test_findings_of_a_file_that_was_read_name_its_lines(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text("# A comment.\n\ntask: wrong\nstates:\n\n  - open: { action: gripper/open }\n")
    task = Task.from_yaml(file)
    with pytest.raises(ratn.InvalidTask) as raised:
        task.check()
    (finding,) = [finding for finding in raised.value.findings if finding.rule == "unknown-action"]
    assert (pathlib.Path(finding.file).name, finding.line) == ("wrong.yaml", 6)
    # Changed in Python, it is another text.
    task.document["states"] = [{"open": {"action": "gripper/release", "resources": ["Gripper"]}}]
    assert task.check() == []


def test_paths_are_valid_wherever_a_task_is_written(tmp_path: pathlib.Path) -> None:
    (tmp_path / "part.yaml").write_text("task: part\nstates: []\n")
    file = tmp_path / "whole.yaml"
    file.write_text(
        "task: whole\nstates:\n  - one: { library: part.yaml }\n  - two: { states: [ { three: { library: part.yaml } } ], variables: { library: part } }\n"
    )
    document = Task.from_yaml(Task.from_yaml(file).standing_alone()).document
    assert document["states"][0]["one"]["library"] == str(tmp_path / "part.yaml")
    assert document["states"][1]["two"]["states"][0]["three"]["library"] == str(tmp_path / "part.yaml")
    assert document["states"][1]["two"]["variables"] == {"library": "part"}


def test_text_that_is_no_yaml_is_refused_with_its_line(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "twice.yaml"
    file.write_text("task: a\ntask: b\n")
    with pytest.raises(ratn.InvalidTask, match=r"twice.yaml:2:1: error\[invalid-yaml\]"):
        Task.from_yaml(file)
    with pytest.raises(ratn.InvalidTask, match="a task file is a mapping"):
        Task.from_yaml("- a\n")


@pytest.mark.parametrize("text", ["yes", "left hand", "a: b", "'quoted' \"twice\"", "1e5", "~", "", "ä€😀\t\n", "null", "-", "#x", "!not", "*x", "0x1F", ".5"])
def test_every_text_survives_yaml(text: str) -> None:
    from ratn import _ratn, _yaml

    document = {"a": text, "b": [text, {"c": text}], "d": {"e": {"f": [{"g": text, "h": [1, 2.5, True, None, 1e-9, -3e200]}]}}}
    assert _ratn.read_yaml("\n".join(_yaml.write(document).text) + "\n", "x") == document


def test_stubs_have_the_actions_of_the_catalogue_and_type_checkers_refuse_what_is_wrong(tmp_path: pathlib.Path) -> None:
    from ratn import _stubs

    shipped = pathlib.Path(ratn.__file__).with_name("actions.pyi").read_text()
    assert shipped.startswith(_stubs.stubs(None, "the built-in catalogue")), "write it anew: `python -m ratn stubs >crates/python/python/ratn/actions.pyi`"
    catalogue = tmp_path / "extra.toml"
    catalogue.write_text(
        '[resources.Eye]\nclass = "process"\ncount = 1\n[providers.eye]\nresource = "Eye"\n'
        '[providers.eye.actions.look]\ninputs = { at = "pose" }\noutputs = { seen = "bool" }\ndescription = "Looks."\n'
    )
    subprocess.run([sys.executable, "-m", "ratn", "stubs", "--catalogue", str(catalogue), str(tmp_path / "robot.py")], check=True)
    good = "import ratn\nfrom robot import eye, gripper\n\n@ratn.task\ndef t() -> None:\n    look = eye.look(at=ratn.Pose(1, 2, 3), computes=True)\n"
    good += "    with ratn.when(look.seen):\n        gripper.grasp(object='cup')\n"
    good += "\n@ratn.step\ndef one() -> None: ...\n\n@ratn.step(reads=[])\ndef two() -> None: ...\n\nkinds: list[str] = [one.kind, two.kind, t.name]\n"
    (tmp_path / "good.py").write_text(good + "\n\nt.check()\nprint(t.to_yaml())\n")
    told = subprocess.run([sys.executable, "good.py"], cwd=tmp_path, capture_output=True, text=True)
    assert "action: eye/look" in told.stdout and "resources: [Eye, world_model]" in told.stdout, told.stderr
    if sys.version_info < (3, 12):
        return  # One interpreter is enough for mypy, which is slow.
    pytest.importorskip("mypy")
    wrong = good.replace("ratn.Pose(1, 2, 3)", "3.5").replace("object=", "thing=").replace("look.seen", "look.sean").replace("one.kind, two.kind, t.name", "one.kid, two.kid, t.nam")
    (tmp_path / "wrong.py").write_text(wrong)
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path / "mypy"), "good.py", "wrong.py"]
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    for part in ('wrong.py:6: error: Argument "at"', 'wrong.py:7: error: "_Eye_Look" has no attribute "sean"', 'wrong.py:8: error: Unexpected keyword argument "thing"'):
        assert part in told.stdout, told.stdout
    for part in ('"Step" has no attribute "kid"', '"Task" has no attribute "nam"'):
        assert part in told.stdout, told.stdout
    assert "good.py" not in told.stdout, told.stdout


def test_the_model_has_no_places_and_no_digest() -> None:
    @ratn.task
    def small() -> None:
        gripper.release()

    text = json.dumps(small.model())
    assert "location" not in text and "digest" not in text and "release" in text


def test_values_and_tasks_show_themselves_also_when_nothing_is_traced() -> None:
    kept: list[ratn.Value] = []

    @ratn.task
    def small() -> None:
        opened = gripper.release()
        kept.append(opened.width_m)
        assert repr(opened.width_m) == "<Value opened.width_m>"

    assert repr(kept[0]) == "<Value of a task that is not being traced>"
    assert small._repr_markdown_().startswith("```yaml\ntask: small\n") and repr(small).startswith("<Task small of ")


def test_waiting_asking_and_functions_are_traced() -> None:
    @ratn.function
    def above(pose: object, by_m: object) -> object:
        return fn.compose(pose, fn.pose(0, 0, by_m))

    @ratn.function
    def is_free(thing: object) -> object:
        return ~ratn.exists(ratn.fact("tidied", thing))

    @ratn.task(outcomes=["nobody"], variables={"order": None})
    def hand_over(pose: ratn.Pose = TABLE) -> dict:
        lid = ratn.wait(ratn.fact("open", "lid"), timeout=60, transitions={"timeout": "nobody"})
        order = ratn.wait(signal="order", assign={"order": ratn.expr("value")})
        ratn.wait(seconds=0.5)
        ratn.wait(until=30)
        pan_tilt.look_at(target=above(pose, 0.1), requires=[is_free("cup")])
        go_on = ratn.ask("May it move?", ["now", "never"], default="now", timeout=120, transitions={"never": "nobody"})
        sure = ratn.ask(fn.concat("Box ", order.value, "?"), ["yes_it_is"])
        ratn.ask("$5 a piece?", ["fine"])
        del lid, sure
        return {"answer": go_on.answer}

    text = hand_over.to_yaml()
    for part in (
        'wait: { for: "open(lid)", timeout: 60 }', "wait: { signal: order }", "wait: { seconds: 0.5 }", "wait: { until: 30 }",
        '"is_free($thing)": "not (exists tidied($thing))"', '"above($pose, $by_m)": "compose($pose, pose(0, 0, $by_m))"', 'target: "above($pose, 0.1)"',
        'ask: { question: "May it move?", choices: [now, never], default: now, timeout: 120 }', "question: \"concat(\\\"Box \\\", order.value, \\\"?\\\")\"",
    ):
        assert part in text, text
    same(hand_over, traced(hand_over.to_python()))
    (one,) = [state for state in hand_over.model()["states"] if "$5 a piece?" in json.dumps(state)]
    assert one["name"] == "ask_operator"

    def twice() -> None:
        ratn.wait(seconds=1, until=2)

    @ratn.function
    def endless(n: object) -> object:
        return endless(n)

    def recursive(n: int) -> None:
        ratn.wait(seconds=endless(n))

    for function, part in ((twice, "waits for one thing"), (recursive, "`endless` uses itself")):
        with pytest.raises(ratn.Untraceable, match=part):
            ratn.task(function)
