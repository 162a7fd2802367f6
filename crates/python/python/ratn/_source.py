"""Python of which a task file can be traced: each state as the call or block that makes it.

Expressions stay in the words of task files (``ratn.expr("…")``): they mean the same there, and every name is seen as it was.
"""

from __future__ import annotations

import json
import keyword
import re
from typing import Any

_INDENT = "    "
#: Keys of a task file that are Python keywords, with their names here.
RENAMED = {"while": "holds"}
_ACTION_KEYS = ("action", "in")
_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?\Z")
_TASK_KEYS = ("description", "horizon", "speculation_width", "deadline", "exceptions", "ontology", "tolerance", "world", "outcomes", "variables", "functions")
#: Keys whose values are expressions: a text there is an expression.
_EXPRESSIONS = ("variables", "assign", "outputs", "decide", "duration")


def python_of(document: dict[str, Any]) -> str:
    """The source text of a module with the task as a function."""
    source = _Source()
    source.task(document)
    head = ["from typing import Annotated", ""] if any("Annotated[" in line for line in source.lines) else []
    return "\n".join([*head, "import ratn", "from ratn import expr", "", "", *source.lines, ""])


def _expression(value: Any) -> str:
    """Python source that gives the same expression again."""
    if isinstance(value, str):
        return f"expr({value!r})"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name!r}: {_expression(item)}" for name, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_expression, value)) + "]"
    return repr(value)


def _output(said: Any) -> str:
    if not isinstance(said, dict) or not ("value" in said or "each" in said):
        return _expression(said)
    more = {"type": repr, "default": _expression, "description": repr}
    rest = "".join(f", {key}={show(said[key])}" for key, show in more.items() if key in said)
    value = f"each={_expression(said['each'])}" if "each" in said else _expression(said["value"])
    return f"ratn.output({value}{rest})"


def _annotations(body: dict[str, Any], without: tuple[str, ...]) -> list[str]:
    said = []
    for key, value in body.items():
        if key in without:
            continue
        key = RENAMED.get(key, key)
        if key == "outputs" and isinstance(value, dict):
            said.append("outputs={" + ", ".join(f"{name!r}: {_output(item)}" for name, item in value.items()) + "}")
        else:
            said.append(f"{key}={_expression(value) if key in _EXPRESSIONS else repr(value)}")
    return said


class _Source:
    def __init__(self) -> None:
        self.lines: list[str] = []
        self.depth = 0

    def line(self, text: str) -> None:
        self.lines.append(_INDENT * self.depth + text)

    def inside(self, states: list[dict[str, Any]]) -> None:
        self.depth += 1
        for state in states or []:
            self.state(state)
        if not states:
            self.line("pass")
        self.depth -= 1

    def task(self, document: dict[str, Any]) -> None:
        name = str(document["task"])
        function = name if name.isidentifier() and not keyword.iskeyword(name) else "task_" + re.sub(r"\W", "_", name)
        said = [] if function == name else [f"name={name!r}"]
        for key in _TASK_KEYS:
            if key in document:
                said.append(f"{key}={_expression(document[key]) if key == 'variables' else repr(document[key])}")
        parameters = document.get("parameters") or {}
        # A required parameter may follow one with a default.
        shown = ", ".join(["*", *(_parameter(name, parameter) for name, parameter in parameters.items())]) if parameters else ""
        self.line(f"@ratn.task({', '.join(said)})" if said else "@ratn.task")
        self.line(f"def {function}({shown}):")
        self.inside(document.get("states") or [])
        outputs = document.get("outputs")
        if outputs:
            self.depth += 1
            self.line("return {" + ", ".join(f"{name!r}: {_output(item)}" for name, item in outputs.items()) + "}")
            self.depth -= 1

    def state(self, item: dict[str, Any]) -> None:
        name, body = named(item)
        body = _written_out(body)
        lastly = body.get("finally")
        if lastly:
            body = {key: value for key, value in body.items() if key != "finally"}
        self.form(name, body)
        if lastly:
            self.block("lastly", [], lastly)

    def form(self, name: str | None, body: dict[str, Any]) -> None:
        called = [] if name is None else [f"name={name!r}"]
        retry = body.get("retry")
        # A loop or a condition keeps its `before` in the language of task files.
        if isinstance(retry, dict) and "before" in retry and ("action" in body or "states" in body):
            self.retried(called, body, retry)
        elif "action" in body:
            inputs = "{" + ", ".join(f"{port!r}: {_expression(value)}" for port, value in (body.get("in") or {}).items()) + "}"
            self.call("action", [repr(body["action"]), inputs, *called, *_annotations(body, _ACTION_KEYS)])
        elif "wait" in body or "ask" in body:
            self.own(called, body)
        elif "library" in body:
            given = "parameters={" + ", ".join(f"{name!r}: {_expression(value)}" for name, value in (body.get("with") or {}).items()) + "}"
            self.call("library", [repr(body["library"]), given, *called, *_annotations(body, ("library", "with"))])
        elif "for" in body:
            variable, _, elements = str(body["for"]).partition(" in ")
            index = [f"index={body['index']!r}"] if "index" in body else []
            arguments = [repr(elements), f"variable={variable.strip()!r}", *index, *called, *_annotations(body, ("for", "index", "do"))]
            self.line(f"for _ in ratn.each({', '.join(arguments)}):")
            self.inside(body.get("do") or [])
        elif "condition" in body:
            self.block("when", [_test(body["condition"]), *called, *_annotations(body, ("condition", "then", "else"))], body.get("then"))
            if "else" in body:
                self.line("with ratn.otherwise():")
                self.inside(body["else"])
        elif "concurrency" in body:
            arguments = [repr(body["concurrency"]), *called, *_annotations(body, ("concurrency", "regions"))]
            self.block("concurrently", arguments, body.get("regions"))
        else:
            self.loop_or_sequence(called, body)

    def own(self, called: list[str], body: dict[str, Any]) -> None:
        """A state that waits or asks."""
        key = "wait" if "wait" in body else "ask"
        said = dict(body[key])
        if key == "ask":
            question = said.pop("question")
            is_text = isinstance(question, str) and not question.startswith(("'", '"', "$", "concat("))
            arguments = [repr(question) if is_text else _expression(question), repr(said.pop("choices"))]
            arguments += [f"{name}={value!r}" for name, value in said.items()]
        else:
            arguments = [repr(said.pop("for"))] if "for" in said else []
            arguments += [f"{name}={value!r}" for name, value in said.items()]
        self.call(key, [*arguments, *called, *_annotations(body, (key,))])

    def loop_or_sequence(self, called: list[str], body: dict[str, Any]) -> None:
        for key, function in (("while", "while_"), ("do_while", "do_while"), ("until", "until")):
            if key in body and "do" in body and not (key == "while" and ("do_while" in body or "until" in body)):
                index = [f"index={body['index']!r}"] if "index" in body else []
                arguments = [_test(body[key]), *index, *called, *_annotations(body, (key, "index", "do"))]
                return self.block(function, arguments, body.get("do"))
        self.block("sequence", [*called, *_annotations(body, ("states",))], body.get("states"))

    def retried(self, called: list[str], body: dict[str, Any], retry: dict[str, Any]) -> None:
        """A block with states before each retry; for a single action, the block is that action."""
        times = [repr(retry["times"])] if "times" in retry else []
        times += [f"{key}={value!r}" for key, value in retry.items() if key in ("on", "backoff")]
        rest = {key: value for key, value in body.items() if key not in ("retry", "states")}
        is_action = "action" in body
        arguments = times if is_action else [*times, *called, *_annotations(rest, ())]
        self.line(f"with ratn.retry({', '.join(arguments)}) as attempt:")
        self.depth += 1
        self.line("with attempt.before():")
        self.inside(retry["before"])
        if is_action:
            name = called[0].partition("=")[2].strip("'") if called else None
            self.state({name: rest} if name else rest)
        else:
            for state in body.get("states") or []:
                self.state(state)
        self.depth -= 1

    def block(self, function: str, arguments: list[str], states: Any) -> None:
        self.line(f"with ratn.{function}({', '.join(arguments)}):")
        self.inside(states)

    def call(self, function: str, arguments: list[str]) -> None:
        text = f"ratn.{function}({', '.join(arguments)})"
        if len(text) + len(_INDENT) * self.depth <= 120:
            return self.line(text)
        self.line(f"ratn.{function}(")
        for argument in arguments:
            self.line(f"{_INDENT}{argument},")
        self.line(")")


_FORMS = ("fallback", "cases", "action", "for", "condition", "states", "while", "do_while", "until", "concurrency", "library", "wait", "ask")
#: Keys that give the kind of a state wherever they occur: no state has such a name. (For `wait` and `ask`, the content decides.)
WORDS_OF_FORMS = frozenset({*_FORMS, "switch"} - {"cases", "wait", "ask"})


def named(item: dict[str, Any]) -> tuple[str | None, dict[str, Any]]:
    """The name of a state in a list, if it has one, and its definition."""
    if len(item) == 1:
        ((key, value),) = item.items()
        if isinstance(value, dict) and not _is_form(key, value):
            return key, value
    return None, item


def _is_form(key: str, value: dict[str, Any]) -> bool:
    """Whether an entry is an unnamed state that waits or asks: states may have these names, too."""
    if key not in ("wait", "ask"):
        return False
    is_state = any(form in value for form in _FORMS)
    return not (is_state and (key == "ask" or not ("for" in value or "until" in value) or "do" in value))


def _written_out(body: dict[str, Any]) -> dict[str, Any]:
    """Expands `switch` to nested conditions, and `fallback` to states with transitions, as the loader does."""
    if "fallback" in body:
        ways = [dict(way) for way in body["fallback"]]
        names = [next(iter(way)) for way in ways]
        for way, following in zip(ways, [*names[1:], None], strict=True):
            ((name, said),) = way.items()
            leads = {**said.get("transitions", {}), "success": "success", **({"aborted": following} if following else {})}
            way[name] = {**said, "transitions": leads}
        return {"states": ways, **{key: value for key, value in body.items() if key != "fallback"}}
    if "cases" in body:
        rest = {key: value for key, value in body.items() if key not in ("switch", "cases", "default")}
        outcomes = {"outcomes": body["outcomes"]} if "outcomes" in body else {}
        otherwise = body.get("default") or []
        for number, (case, states) in reversed(list(enumerate(body["cases"].items()))):
            value = str(case) if str(case).isidentifier() or isinstance(case, (int, float)) else json.dumps(str(case), ensure_ascii=False)
            condition = {"condition": f"({body['switch']}) = {value}", "then": states or [], "else": otherwise}
            otherwise = [{"else": {**condition, **outcomes}}]
        return {**condition, **rest}
    return body


def _test(condition: Any) -> str:
    return repr(condition)


def _parameter(name: str, said: Any) -> str:
    is_long = isinstance(said, dict) and ("type" in said or "default" in said)
    if not is_long:
        return f"{name}={_expression(said)}"
    if "type" not in said:
        return f"{name}={_expression(said['default'])}"
    about = f", ratn.Doc({said['description']!r})" if "description" in said else ""
    kind = f": Annotated[object, {said['type']!r}{about}]"
    default = f" = {_expression(said['default'])}" if "default" in said else ""
    return f"{name}{kind}{default}"
