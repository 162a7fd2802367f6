"""Views of a run from its event log, as objects that display themselves in a notebook. All content comes from the native part, which reads the log."""

from __future__ import annotations

import html
import importlib
import json
import os
import pathlib
from collections.abc import Iterable
from typing import Any

from ratn import _ratn
from ratn._ratn import NotFound


def _table(rows: Iterable[dict[str, Any]], columns: list[str]) -> str:
    def cell(value: object) -> str:
        text = f"{value:.2f}" if isinstance(value, float) else "" if value is None else ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        return f"<td>{html.escape(text)}</td>"

    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(cell(row.get(column)) for column in columns) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


class Records(list[dict[str, Any]]):
    """Records of one kind, all with the same keys: a list of dicts that shows itself as a table."""

    _shown: list[str] | None = None

    def _repr_html_(self) -> str:
        return _table(self, self._shown or (list(self[0]) if self else []))

    def to_arrow(self) -> Any:
        """A ``pyarrow.Table`` with a column for each key."""
        try:
            pyarrow: Any = importlib.import_module("pyarrow")
        except ImportError:
            raise ImportError("`to_arrow` needs pyarrow: `pip install pyarrow`") from None
        return pyarrow.Table.from_pylist(list(self))


class Nodes(Records):
    """One record per attempt to perform a node."""

    _shown = ["path", "action", "attempt", "began_s", "ended_s", "outcome", "activity", "resources", "ahead_of_time"]


class CriticalPath(Records):
    """The critical path of a run, from its start to its end: one record per link."""

    _shown = ["path", "stage", "from_s", "to_s", "waited_for"]

    def __str__(self) -> str:
        return "\n".join(f"{link['from_s']:9.2f} – {link['to_s']:7.2f} s  {link['path']}: {link['stage']}, {link['waited_for']}" for link in self)


class Why(Records):
    """What the visits of a state waited for, and for how long: one record per visit, which explains it in sentences when printed."""

    def __str__(self) -> str:
        return "\n".join(line for visit in self for line in _sentences(visit))

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


def _sentences(visit: dict[str, Any]) -> list[str]:
    lines = [f"{visit['path']} ({visit['stage']}{', ' + visit['outcome'] if visit['outcome'] else ''})"]
    for phase in visit["phases"]:
        length_s, stage = phase["to_s"] - phase["from_s"], phase["stage"]
        if length_s < 0.0005:
            continue
        line = f"  {phase['from_s']:8.2f} s  {stage} for {length_s:.2f} s"
        if stage == "waiting":
            line += f", until {phase['waited_for']}"
        elif stage == "finished":
            line += f", until it became real, with {phase['waited_for']}"
        lines.append(line)
    for wait in visit["resources"]:
        behind = ", ".join(f"{one['resource']} was held by {one['holder']}" for one in wait["held_by"])
        if behind:
            lines.append(f"  {wait['from_s']:8.2f} s  asked for {', '.join(wait['kinds'])}: {behind}")
    lines += [f"  done again: {reason}" for reason in visit["invalidated"]]
    if visit["now"]:
        lines.append(f"  now: {visit['now']}")
    return lines


class Chart:
    """A chart that notebooks display."""

    def __init__(self, svg: str) -> None:
        #: The picture, as SVG.
        self.svg = svg

    def _repr_svg_(self) -> str:
        return self.svg

    def _repr_html_(self) -> str:
        return self.svg

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the chart to a file, ``run.svg``."""
        pathlib.Path(path).write_text(self.svg, encoding="utf-8")


class Network:
    """The dataflow network of a run, as a Mermaid graph that notebooks display."""

    def __init__(self, mermaid: str) -> None:
        #: The graph, in Mermaid's language.
        self.mermaid = mermaid

    def __str__(self) -> str:
        return self.mermaid

    def _repr_markdown_(self) -> str:
        return f"```mermaid\n{self.mermaid}\n```"


class Report(dict[str, Any]):
    """The output of ``ratn report``, as a dict; its text is the table for people."""

    def __init__(self, log: _ratn.Log) -> None:
        super().__init__(json.loads(log.report()))
        self._text = log.report_text()

    def __str__(self) -> str:
        return self._text

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self._text)}</pre>"


class Log:
    """An event log of a run, under way or ended, also from another machine. ``ratn.Log("run.jsonl").gantt()``."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._log = _ratn.Log(path)

    def nodes(self) -> Nodes:
        """One record per attempt to perform a node, in the order in which they began.

        ``path`` (``for_box[0]/move``), ``provider``, ``action``, ``attempt``, ``began_s`` and ``ended_s`` (seconds of the robot's time since the run
        began), ``outcome`` and ``reason``; ``activity`` (``motion detection planning other``), ``resources``, whether it was ``speculative`` and
        begun ``ahead_of_time``, and what happened to its ``result`` (``used lost open``). Attempts under way have ``None`` as end and outcome; the
        outcome is ``cancelled`` if the attempt was given up, and ``crashed`` if its worker died.
        """
        return Nodes(json.loads(self._log.nodes()))

    def why(self, name: str) -> Why:
        """What the visits of a state waited for, given by its path or name: the stages of each, what ended each stage, and who held the requested resources.

        Raises ``ratn.NotFound`` if the run has no such state.
        """
        visits = json.loads(self._log.why(name))
        if not visits:
            paths = ", ".join(self._log.paths()[:40])
            raise NotFound(f"no state of the run is called `{name}` (yet); there are {paths}")
        return Why(visits)

    def critical_path(self) -> CriticalPath:
        """The critical path: what the run waited for, from its start to its end. Empty if the run has not ended."""
        return CriticalPath(json.loads(self._log.critical_path()))

    def gantt(self, by: str = "resource") -> Chart:
        """The Gantt chart, as SVG; one row per ``resource`` or per ``node``."""
        return Chart(self._log.gantt(by))

    def report(self) -> Report:
        """Where the time went: the output of ``ratn report --json``, as a dict that is shown as the table."""
        return Report(self._log)

    def _repr_html_(self) -> str:
        return f"{self._log.gantt('resource')}{self.report()._repr_html_()}"
