"""Names in traced tasks: a name stands for what Python means by it, or the task is refused with the line and with what to write instead."""

from __future__ import annotations

import enum
import json
import pathlib
import re
from collections.abc import Callable

import pytest
import ratn
from ratn import fn
from ratn.actions import detector, gripper, pan_tilt

PRINTER = """
[resources.Printer]
class = "process"
count = 1
[providers.printer]
resource = "Printer"
[providers.printer.actions.say]
optional = { text = "any", colour = "any", size = "any", both = "any", by = "any" }
"""
REGION = {"pose": ratn.Pose(0.8, 0, 0.7), "size": [0.6, 1.2]}


def refused(function: Callable[..., object], *parts: str) -> str:
    with pytest.raises(ratn.Untraceable) as wrong:
        ratn.task(function)
    message = str(wrong.value)
    assert all(part in message for part in parts) and message.startswith(f"{__file__}:"), message
    return message


def fine(task: ratn.Task) -> bool:
    """Whether the check lets the task pass, here and as `ratn check` does it: a fault raises."""
    # Who performs the actions of these tests that are in no catalogue.
    task._catalogues.append(PRINTER)
    return all(found.severity != "error" for found in [*task.check(), *task._check_with(None, None)])


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
    assert fine(twice)


def test_a_block_that_is_spoken_of_later_hides_none_of_what_is_inside() -> None:
    @ratn.task
    def later() -> None:
        with ratn.when("1 > 0"):
            with ratn.sequence("condition_2"):
                seen = find()
                look(fn.pose(fn.len(seen.boxes), 0, 0))
        look(fn.pose(fn.len(fn.either(seen.boxes, [])), 0, 0))

    (block, _) = later.document["states"]
    assert [*block] == ["condition_3"], later.to_yaml()
    assert fine(later)


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

    assert "seen.boxes" in branches.to_yaml() and fine(branches)


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
            for number, _element in ratn.each([1], index=True):
                look(fn.pose(number, 0, 0))

    loop, inner = counts.document["states"][0]["outer"], "inner"
    assert (loop["index"], loop["do"][0][inner]["index"]) == ("iteration_2", "iteration")
    assert loop["do"][0][inner]["do"][0]["look_at"]["in"]["target"] == "pose($iteration, $iteration_2, 0)"
    assert fine(counts)


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

    assert total.document["outputs"]["whole"].startswith("(0 + ") and fine(total)


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
        assert isinstance(said, ratn.Value)

    def expression(n: int) -> None:
        look(fn.concat(f"{n}"))

    for function in (given, nested, asked, named, returned, assigned, expression):
        refused(function, "fn.concat(")

    @ratn.task(world=["at(1) = 2"])
    def annotated(n: int) -> None:
        pan_tilt.look_at(target=ratn.expr(f"pose({n}, 0, 0)"), requires=[f"at({n}) = {n + 1}"], effects=[f"at({n}) = 1"])
        with ratn.when(f"{n} > 1"):
            gripper.release()
        for i in ratn.each(f"range({n})", transitions={"aborted": "success"}):
            look(fn.pose(i, 0, 0))

    text = annotated.to_yaml()
    assert "pose($n, 0, 0)" in text and "at($n) = $n + 1" in text and '"$n > 1"' in text and "i in range($n)" in text and "\u2063" not in text, text
    assert fine(annotated)


def test_a_member_of_an_enumeration_is_its_value() -> None:
    class Colour(str, enum.Enum):
        RED = "red"

    class Size(enum.IntEnum):
        LARGE = 3

    class Kind(str, enum.Enum):
        BARRIER = "barrier"

    @ratn.task
    def enumerations(colour: str = Colour.RED, size: int = Size.LARGE) -> dict:  # type: ignore[type-arg]
        ratn.action("printer/say", {"colour": Colour.RED, "size": Size.LARGE, "both": [Size.LARGE, {"colour": Colour.RED}]}, resources=["Printer"])
        return {"more": fn.len([Size.LARGE, Colour.RED]) + Size.LARGE}

    text = enumerations.to_yaml()
    for part in ("in: { colour: red, size: 3, both: [3, { colour: red }] }", 'more: "len([3, red]) + 3"', "default: red", "default: 3"):
        assert part in text, text
    assert "Colour" not in text and "LARGE" not in text and fine(enumerations)

    @ratn.task
    def names() -> dict:  # type: ignore[type-arg]
        ratn.action("printer/say", {"by": {Colour.RED: 1, Size.LARGE: 2}, "text": fn.len({Colour.RED: 1})}, name=Colour.RED, resources=["Printer"])
        for kind in (Size.LARGE, Kind.BARRIER):
            with ratn.concurrently(kind):
                for _ in range(3):
                    gripper.release(shared=["in_gripper(?)"])
        return {Colour.RED: 1}

    text = names.to_yaml()
    for part in ("- red:", "by: { red: 1, \"3\": 2 }", 'text: "len({red: 1})"', "concurrency: 3", "concurrency: barrier", "outputs: { red: 1 }"):
        assert part in text, text
    assert "Colour" not in text and "LARGE" not in text and "BARRIER" not in text and fine(names)


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
    assert [*block] == ["condition_2"] and state["look_at"]["transitions"] == {"aborted": "condition_2"}
    assert fine(leads)


def test_a_name_that_is_given_is_free_among_those_that_a_task_file_gives() -> None:
    @ratn.task
    def many() -> dict:  # type: ignore[type-arg]
        for _ in range(3):
            with ratn.when("1 > 0"):
                gripper.release()
        with ratn.when("1 > 0"):
            seen = find()
        for _ in range(2):
            for at in ratn.each([1, 2]):
                last = pan_tilt.look_at(target=fn.pose(at, 0, 0))
        return {"boxes": fn.either(seen.boxes, []), "pan": fn.either(last.pan, 0)}

    assert fine(many) and many.document["outputs"] == {"boxes": "either(condition_4.boxes, [])", "pan": "either(for_at_2.pan, 0)"}


def test_a_block_without_a_name_is_no_word_of_a_task_file() -> None:
    @ratn.task
    def when() -> dict:  # type: ignore[type-arg]
        with ratn.when("1 > 0"):
            seen = find()
        return {"boxes": fn.either(seen.boxes, [])}

    @ratn.task
    def while_() -> dict:  # type: ignore[type-arg]
        with ratn.while_("1 > 2"):
            boxes = ratn.collect(find().boxes)
        return {"boxes": boxes}

    @ratn.task
    def do_while() -> dict:  # type: ignore[type-arg]
        with ratn.do_while("1 > 2"):
            seen = find()
        return {"boxes": seen.boxes}

    @ratn.task
    def until() -> dict:  # type: ignore[type-arg]
        with ratn.until("1 > 0"):
            seen = find()
        return {"boxes": seen.boxes}

    @ratn.task
    def concurrently() -> dict:  # type: ignore[type-arg]
        with ratn.concurrently():
            seen = find()
            gripper.release(shared=["in_gripper(?)"])
        return {"boxes": seen.boxes}

    for task in (when, while_, do_while, until, concurrently):
        assert fine(task), task.to_yaml()


def test_what_is_concurrent_has_a_name() -> None:
    @ratn.task
    def twice() -> None:
        for _ in range(2):
            with ratn.concurrently():
                gripper.release(shared=["in_gripper(?)"])

    assert fine(twice) and [*twice.document["states"][1]] == ["concurrently_2"]


def test_a_state_is_called_by_no_word_of_a_task_file() -> None:
    words = ["action", "in", "states", "condition", "for", "while", "do_while", "until", "concurrency", "library", "switch", "fallback", "exists", "or"]
    for word in words:

        def called() -> None:
            gripper.release(name=word)

        refused(called, f"a state cannot be called `{word}`")

    @ratn.task
    def implied() -> None:
        action = gripper.release()
        switch = gripper.release()
        wait = ratn.wait(seconds=1)
        assert {action is switch, wait is switch} == {False}

    assert fine(implied) and [name for state in implied.document["states"] for name in state] == ["action_2", "switch_2", "wait"]


@pytest.mark.parametrize("word", ["duration", "outputs", "assign", "variables", "decide", "with"])
def test_a_word_of_states_is_a_name_where_it_stands_in_a_list(word: str) -> None:
    """Which file or action a state has is found whatever it and those around it are called."""

    @ratn.step
    def one() -> dict:  # type: ignore[type-arg]
        return {"a": 1}

    @ratn.task
    def named() -> None:
        with ratn.sequence(word):
            one(name=word)
            ratn.library("part.yaml", name=f"{word}_2", parameters={"library": "x"})

    (provider,) = named._step_files()
    own = named._with_providers({provider: "own"})
    block = own.document["states"][0][word]["states"]
    assert block[0][word]["action"] == "own/one" and block[0][word]["resources"] == ["Own"]
    stands_alone = "\n".join(named._standing_alone().text)
    assert str(named.folder / "part.yaml") in stands_alone and "library: x" in stands_alone, stands_alone


def test_a_transition_leads_to_a_state_beside() -> None:
    def inner() -> None:
        seen = find()
        with ratn.sequence("block"):
            detector.segment(region=REGION, name="seen")
            pan_tilt.look_at(target=REGION["pose"], transitions={"aborted": seen})

    refused(inner, "a transition leads to the state `seen` of", "is not beside the one that has it")

    @ratn.task
    def tried_again() -> None:
        seen = find()
        with ratn.retry(2):
            pan_tilt.look_at(target=REGION["pose"], transitions={"aborted": seen})

    assert fine(tried_again)


def test_what_is_said_in_a_list_that_is_gone_is_of_no_other_list() -> None:
    @ratn.task
    def gone() -> None:
        seen = find()
        with ratn.retry(2):
            look(fn.pose(fn.len(seen.boxes), 0, 0))
        with ratn.sequence("block"):
            detector.segment(region=REGION, resources=["Detector", "Camera"], name="seen")

    assert fine(gone)


def test_what_a_text_names_is_what_it_is_where_the_text_is_used() -> None:
    @ratn.task
    def elements() -> dict:  # type: ignore[type-arg]
        seen = find()
        large = fn.filter(seen.boxes, lambda b: ratn.expr(f"{b}.size[0] > 0.1"))
        known = fn.filter(seen.boxes, lambda b: ratn.exists(f"at({b.id})"))
        return {"large": large, "known": known}

    assert elements.document["outputs"] == {
        "large": "filter($b in seen.boxes, $b.size[0] > 0.1)", "known": "filter($b in seen.boxes, exists (at($b.id)))",
    }
    assert fine(elements)

    def other_loop() -> None:
        for box in ratn.each([1, 2]):
            text = f"at({box}) = 1"
        for box in ratn.each([3, 4]):
            gripper.release(effects=[text])

    def other_state() -> None:
        with ratn.sequence("one"):
            seen = find()
            text = f"len({seen.boxes}) > 0"
        detector.segment(region=REGION, name="boxes")
        with ratn.when(text):
            gripper.release()

    refused(other_loop, "the element of the loop `$box`")
    # What is inside of a block is put out by it.
    other = ratn.task(other_state)
    assert "len(one.boxes) > 0" in other.to_yaml() and fine(other), other.to_yaml()

    def taken_apart(n: int) -> None:
        gripper.release(effects=[f"{n}"[:2]])

    refused(taken_apart, "was taken apart")

    @ratn.task
    def split(n: int) -> None:
        gripper.release(effects=[f"at(cup) = {n + 1}".split(" = ")[0] + " = " + f"{n + 1} = x".split(" = ")[0]])

    assert "at(cup) = $n + 1" in split.to_yaml() and fine(split)

    kept: list[str] = []

    @ratn.task
    def first(n: int) -> None:
        gripper.release()
        kept.append(f"at({n}) = 1")

    def second(n: int) -> None:
        gripper.release(effects=kept)

    refused(second, "a value of another task")


def test_what_a_loop_binds_is_not_known_in_what_is_done_lastly() -> None:
    def lastly() -> None:
        for box in ratn.each(find().boxes):
            look(box.pose)
        with ratn.lastly():
            look(box.pose)

    refused(lastly, "the element of the loop `$box`", "is not known here")


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
    actions += [{**actions[0], "action": "eye/own", "inputs": {"self": "pose", "annotations": "pose"}}]
    actions += [{**actions[0], "action": name} for name in ("eye_look/at", "eye/look_at")]
    catalogue = _stubs.toml(actions)
    known = json.loads(_ratn.catalogue([catalogue]))["providers"]["eye"]["actions"]["look"]
    assert known["description"] == text and known["annotations"] == said
    stubs = _stubs.stubs(catalogue, "a test")
    assert "self: ratn.Pose" not in stubs and "        annotations:" not in stubs
    assert sorted(set(classes := re.findall(r"^class (\w+)", stubs, re.M))) == sorted(classes), "one class for each name"
    compile(stubs, "stubs.pyi", "exec")
    assert "def look(" in stubs and "3d_scan" not in stubs and "odd" not in stubs.partition("class _Odometry")[0]




@ratn.function
def near(a: object, b: object) -> object:
    return fn.distance(a, b) < 0.5


def test_a_comparison_that_python_decides_alone_is_refused() -> None:
    def given(n: int) -> None:
        if n is None:
            pan_tilt.look_at(target=REGION["pose"])

    def turned(n: int = 3) -> None:
        assert None is not n

    def output() -> None:
        seen = other = detector.segment(region=REGION)
        if seen.boxes[0].size is not None:
            find()

    def named() -> None:
        seen = detector.segment(region=REGION)
        boxes = fn.filter(seen.boxes, lambda box: box.size[0] > 0.1)
        first = boxes[0].pose @ ratn.Pose()
        print(first is None)

    def both(n: int, m: int) -> None:
        more = n
        more = more + m
        print(more is None)

    def looped() -> None:
        seen = detector.segment(region=REGION)
        for number, box in ratn.each(seen.boxes, index=True):
            print(0 if box.pose is None else number)

    def waited() -> None:
        order = ratn.wait(signal="order")
        if order.value is True:
            find()

    def false(n: bool) -> None:
        print(n is not False)

    def of_elements(n: list) -> None:
        fn.filter(n, lambda x: x is not None)

    def of_function(n: ratn.Pose) -> None:
        print(near(n, n) is None)

    def matched(n: int) -> None:
        match n:
            case None:
                find()

    expected = {
        given: "ratn.when(n == None)", turned: "n != None", output: "seen.boxes[0].size != None", named: "first == None", both: "more == None",
        looped: "box.pose == None", waited: "ratn.when(order.value)", false: "ratn.when(n)", of_elements: "x != None", of_function: "near(n, n) == None",
        matched: "`case None` is decided by Python now",
    }
    for function, part in expected.items():
        refused(function, "is decided by Python now", part)
    with pytest.raises(ratn.Untraceable, match="a != None"):

        @ratn.function
        def there(a: object) -> object:
            return a is not None


def perhaps(what: object = None) -> object:
    """What Python may compare with `None`: whether something was given."""
    return 1 if what is None else what


def test_a_comparison_of_what_python_knows_is_traced() -> None:
    @ratn.task
    def plain(n: int, m: int = 2) -> object:
        before = None
        for at in (REGION["pose"], None):
            if at is None:
                continue
            seen = detector.segment(region=REGION, resources=["Detector", "Camera"])
            if before is not None:
                look(before.boxes[0].pose)
            before = seen
        found = perhaps(n)
        if found is None or before is None or perhaps() is None or seen is None:
            raise AssertionError
        m = perhaps()
        if m is None:
            raise AssertionError
        return {"found": found, "given": [1 if each is None else 2 for each in (n, None)]}

    assert plain.document["outputs"] == {"found": "$n", "given": [2, 1]} and len(plain.document["states"]) == 1
    # Without its source nothing is refused.
    module: dict[str, object] = {"__name__": "typed"}
    exec("def typed(n):\n    return {'given': n is not None}", module)
    assert ratn.task(module["typed"]).document["outputs"] == {"given": True}


@pytest.mark.parametrize("decorated", [int, 3, "look", ratn.Pose()])
def test_what_is_no_function_is_no_task(decorated: object) -> None:
    with pytest.raises(TypeError, match="`ratn.task` takes a function, and is given the"):
        ratn.task(decorated)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"ü": 1, "a b": [2, None], "not": True}, '{"ü": 1, "a b": [2, null], not: true}'),
        ('two\n"words"\t\\ \r', '"two\\n\\"words\\"\\t\\\\ \r"'),
        ({1: -(2**63), "": 2**63 - 1}, '{"1": (-9223372036854775807 - 1), "": 9223372036854775807}'),
    ],
)
def test_a_value_is_written_in_the_words_of_the_language(value: object, text: str) -> None:
    from ratn._expression import expression

    assert expression(value) == text
    with pytest.raises(ratn.Untraceable, match="64 bits"):
        expression(2**63)
