"""Names in traced tasks: a name stands for what Python means by it, or the task is refused with the line and with what to write instead."""

from __future__ import annotations

import enum
import json
import pathlib
from collections.abc import Callable

import pytest
import ratn
from ratn import fn
from ratn.actions import detector, gripper, pan_tilt

REGION = {"pose": ratn.Pose(0.8, 0, 0.7), "size": [0.6, 1.2]}


def refused(function: Callable[..., object], *parts: str) -> str:
    with pytest.raises(ratn.Untraceable) as wrong:
        ratn.task(function)
    message = str(wrong.value)
    assert all(part in message for part in parts) and message.startswith(f"{__file__}:"), message
    return message


def look(at: object) -> ratn.State:
    return pan_tilt.look_at(target=at, pia=True, effects=["pan_tilt_at(pan_tilt) = there"])


def find() -> ratn.State:
    seen = detector.segment(region=REGION, resources=["Detector", "Camera"])
    return seen


def test_a_state_without_a_name_of_its_own_hides_none_of_what_is_around() -> None:
    @ratn.task
    def twice() -> None:
        first = find()
        with ratn.sequence("again"):
            second = find()
            look(fn.pose(fn.len(first.boxes), fn.len(second.boxes), 0))

    outer, inner = twice.document["states"]
    assert [*outer] == ["seen"] and [*inner["again"]["states"][0]] == ["seen_2"]
    assert inner["again"]["states"][1]["look_at"]["in"]["target"] == "pose(len(seen.boxes), len(seen_2.boxes), 0)"


def test_a_block_that_is_spoken_of_later_hides_none_of_what_is_inside() -> None:
    @ratn.task
    def later() -> None:
        with ratn.when("1 > 0"):
            with ratn.sequence("condition"):
                seen = find()
                look(fn.pose(fn.len(seen.boxes), 0, 0))
        look(fn.pose(fn.len(fn.either(seen.boxes, [])), 0, 0))

    (block, _) = later.document["states"]
    assert [*block] == ["condition_2"], later.to_yaml()


def test_a_state_that_is_hidden_by_another_one_is_refused() -> None:
    def before() -> None:
        seen = find()
        with ratn.sequence("block"):
            detector.segment(region=REGION, name="seen")
            look(fn.len(seen.boxes))

    def after() -> None:
        seen = find()
        with ratn.sequence("block"):
            look(fn.len(seen.boxes))
            detector.segment(region=REGION, name="seen")

    for function in (before, after):
        refused(function, "the state `seen` of", "is hidden here by another one of its name", "name=")


def test_states_of_different_branches_do_not_hide_each_other() -> None:
    @ratn.task
    def branches() -> None:
        with ratn.when("1 > 0"):
            one = detector.segment(region=REGION, name="seen")
        with ratn.otherwise():
            other = detector.segment(region=REGION, name="seen")
        look(fn.pose(fn.len(fn.either(one.boxes, other.boxes)), 0, 0))

    assert "seen.boxes" in branches.to_yaml()


def test_a_variable_that_is_hidden_by_another_one_is_refused() -> None:
    def element() -> None:
        for box in ratn.each(find().boxes):
            outer = box
            for box in ratn.each(find().boxes):
                look(fn.compose(outer.pose, box.pose))

    def scoped() -> None:
        tries = ratn.variable(0)
        with ratn.sequence("block"):
            ratn.variable(5, name="tries")
            look(tries)

    def scoped_later() -> None:
        tries = ratn.variable(0)
        with ratn.sequence("block"):
            look(tries)
            ratn.variable(5, name="tries")

    def said(tries: int) -> None:
        with ratn.sequence("block", variables={"tries": 1}):
            look(tries)

    def parameter(box: int) -> None:
        outer = box
        for box in ratn.each([1, 2]):
            look(outer)

    def of_elements() -> None:
        for box in ratn.each(find().boxes):
            outer = box
            look(fn.len(fn.filter([1, 2], lambda box: box > outer.size)))

    def of_elements_of_elements() -> None:
        look(fn.len(fn.map([[1]], lambda b: fn.filter(b, lambda x, outer=b: fn.len(fn.map([1], lambda b: b + outer)) > x))))

    for function, part in [
        (element, "element of the loop `$box`"), (scoped, "variable `$tries`"), (scoped_later, "already"), (said, "parameter `$tries`"),
        (parameter, "parameter `$box`"), (of_elements, "element of the loop `$box`"), (of_elements_of_elements, "element `$b`"),
    ]:
        refused(function, part, "another name")


def test_two_variables_of_one_name_are_refused() -> None:
    def twice() -> None:
        for number in (1, 2):
            tries = ratn.variable(number)
        look(tries)

    def parameter(tries: int) -> None:
        look(ratn.variable(0, name="tries"))

    refused(twice, "the variable `$tries`", "already")
    refused(parameter, "the parameter `$tries`", "already")


def test_numbers_of_iterations_are_told_apart() -> None:
    @ratn.task
    def counts() -> None:
        with ratn.while_("1 > 0") as outer:
            with ratn.while_("1 > 0") as inner:
                look(fn.pose(inner.index, outer.index, 0))
        for _ in ratn.each([1]):
            for number, _ in ratn.each([1], index=True):
                look(number)

    loop, inner = counts.document["states"][0]["outer"], "inner"
    assert (loop["index"], loop["do"][0][inner]["index"]) == ("iteration_2", "iteration")
    assert loop["do"][0][inner]["do"][0]["look_at"]["in"]["target"] == "pose($iteration, $iteration_2, 0)"


def test_what_a_loop_binds_is_known_only_inside() -> None:
    def after() -> None:
        for box in ratn.each(find().boxes):
            kept = box
        for box in ratn.each(find().boxes):
            look(kept.pose)

    refused(after, "element of the loop `$box`", "another name")

    def behind() -> None:
        for box in ratn.each(find().boxes):
            look(box.pose)
        look(box.pose)

    refused(behind, "element of the loop `$box`", "is not known here", "ratn.collect(value)")


def test_a_function_of_the_task_sees_its_parameters_only() -> None:
    def of_variable(n: int) -> None:
        @ratn.function
        def more(m: object) -> object:
            return m + n

        look(more(1))

    def of_same_name(n: int) -> None:
        outer = n

        @ratn.function
        def more(n: object) -> object:
            return n + outer

        look(more(1))

    def of_state() -> None:
        seen = find()

        @ratn.function
        def more(m: object) -> object:
            return m + fn.len(seen.boxes)

        look(more(1))

    for function in (of_variable, of_same_name):
        refused(function, "`$n`", "another")
    refused(of_state, "`more` sees its parameters and facts only, and uses the state `seen`", "another parameter")


def test_operators_in_place_are_refused_with_what_to_write() -> None:
    def variable() -> None:
        tries = ratn.variable(0)
        tries += 1
        look(tries)

    def parameter(n: int) -> None:
        n *= 2
        look(n)

    def number() -> None:
        with ratn.while_("1 > 0") as loop:
            index = loop.index
            index -= 1

    refused(variable, "`tries += …`", 'assign={"tries": tries + …}')
    refused(parameter, "`n *= …`", "`more = n * …`")
    refused(number, "`iteration -= …`", "ratn.variable(0)")

    @ratn.task
    def total() -> dict:  # type: ignore[type-arg]
        seen, whole = find(), 0
        for part in (1, 2):
            whole += fn.len(seen.boxes) * part
        return {"whole": whole}

    assert total.document["outputs"]["whole"].startswith("(0 + ")


def test_an_f_string_that_is_no_annotation_is_refused() -> None:
    def given(n: int) -> None:
        ratn.action("printer/say", {"text": f"box {n}"}, resources=["Printer"])

    def nested(n: int) -> None:
        ratn.action("printer/say", {"text": {"a": ["box " + str(n)]}}, resources=["Printer"])

    def asked(n: int) -> None:
        ratn.ask(f"Take {n}?", ["yes_do"])

    def named(n: int) -> None:
        gripper.release(name=f"release_{n}")

    def returned(n: int) -> dict:  # type: ignore[type-arg]
        return {"text": f"{n} boxes"}

    def assigned(n: int) -> None:
        said = ratn.variable("")
        gripper.release(assign={"said": f"{n} boxes"})
        assert said is not None

    def expression(n: int) -> None:
        look(fn.concat(f"{n}"))

    for function in (given, nested, asked, named, returned, assigned, expression):
        refused(function, "fn.concat(")

    @ratn.task
    def annotated(n: int) -> None:
        pan_tilt.look_at(target=ratn.expr(f"pose({n}, 0, 0)"), requires=[f"at({n}) = {n + 1}"], effects=[f"at({n}) = 1"])
        with ratn.when(f"{n} > 1"):
            gripper.release()
        for i in ratn.each(f"range({n})", transitions={"aborted": "success"}):
            look(i)

    text = annotated.to_yaml()
    assert "pose($n, 0, 0)" in text and "at($n) = $n + 1" in text and '"$n > 1"' in text and "i in range($n)" in text and "\u2063" not in text, text


def test_a_member_of_an_enumeration_is_its_value() -> None:
    class Colour(str, enum.Enum):
        RED = "red"

    class Size(enum.IntEnum):
        LARGE = 3

    @ratn.task
    def enumerations(colour: str = Colour.RED, size: int = Size.LARGE) -> dict:  # type: ignore[type-arg]
        ratn.action("printer/say", {"colour": Colour.RED, "size": Size.LARGE, "both": [Size.LARGE, {"colour": Colour.RED}]}, resources=["Printer"])
        return {"more": fn.len([Size.LARGE, Colour.RED]) + Size.LARGE}

    text = enumerations.to_yaml()
    for part in ("in: { colour: red, size: 3, both: [3, { colour: red }] }", 'more: "len([3, red]) + 3"', "default: red", "default: 3"):
        assert part in text, text
    assert "Colour" not in text and "LARGE" not in text


def test_a_state_is_no_value() -> None:
    def whole() -> None:
        look(find())

    refused(whole, "a state is no value", "`look.boxes`")


def test_a_state_without_a_name_is_named_where_transitions_lead_to_it() -> None:
    @ratn.task
    def leads() -> None:
        blocks = [ratn.when("1 > 0")]
        with blocks[0]:
            gripper.release()
        pan_tilt.look_at(target=REGION["pose"], transitions={"aborted": blocks[0]})

    block, state = leads.document["states"]
    assert [*block] == ["condition"] and state["look_at"]["transitions"] == {"aborted": "condition"}


def test_what_is_said_of_steps_may_be_said_once(tmp_path: pathlib.Path) -> None:
    """An iterator is read once, and the worker reads again."""

    @ratn.step(reads=(pattern for pattern in ["at(?)"]), requires=iter(["open(lid)"]), outcomes=iter(["odd"]))
    def one() -> dict:  # type: ignore[type-arg]
        return {"a": 1}

    again = one._known_to(ratn.Worker("again"))
    assert (again.reads, again.requires, again.outcomes) == (["at(?)"], ["open(lid)"], ["odd"])


@pytest.mark.parametrize("text", ["plain", 'with "quotes"', "ends with a \"", "a \\ and a \x7f", "Zählt 🤖\n\t"])
def test_descriptions_survive_a_catalogue_and_stubs(text: str) -> None:
    from ratn import _ratn, _stubs

    said = {"computes": True, "reads": ["at(?)", 'at("ö")'], "effects": [], "duration": "0.5", "anytime": True}
    actions = [{"action": "eye/look", "resource": "Eye", "inputs": {"at": "pose"}, "description": text, "annotations": said, "defaults": {}}]
    # Names that are none of Python are no stubs.
    actions += [{**actions[0], "action": name} for name in ("eye/3d_scan", "eye/a.b-c", "eye/class", "odd-one/look")]
    catalogue = _stubs.toml(actions)
    known = json.loads(_ratn.catalogue([catalogue]))["providers"]["eye"]["actions"]["look"]
    assert known["description"] == text and known["annotations"] == said
    stubs = _stubs.stubs(catalogue, "a test")
    compile(stubs, "stubs.pyi", "exec")
    assert "def look(" in stubs and "3d_scan" not in stubs and "odd" not in stubs.partition("class _Odometry")[0]


