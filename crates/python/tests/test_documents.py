"""The tutorial is a notebook that goes through, and the reference is what the docstrings say."""

from __future__ import annotations

import ast
import importlib.util
import json
import linecache
import os
import pathlib
import subprocess
import sys

import pytest
import ratn
from conftest import ROOT, TESTS, program

NOTEBOOK = ROOT / "docs" / "python-tutorial.ipynb"


def cells() -> list[str]:
    return ["".join(cell["source"]) for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RATN", program())
    monkeypatch.delenv("RATN_RUNTIME_DIR", raising=False)


def shown(value: object) -> dict[str, str]:
    """What a notebook asks of the value of a cell's last line."""
    forms = {name: getattr(value, name, None) for name in ("_repr_html_", "_repr_svg_", "_repr_markdown_")}
    return {name: said for name, form in forms.items() if callable(form) and (said := form())}


def test_the_cells_of_the_tutorial_go_through(capsys: pytest.CaptureFixture[str]) -> None:
    module: dict[str, object] = {"__name__": "__main__"}
    pictures: list[str] = []
    for number, source in enumerate(cells()):
        name = f"<cell {number}>"
        linecache.cache[name] = (len(source), None, source.splitlines(True), name)
        tree = ast.parse(source, name)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, name, "exec"), module)
        if last is not None:
            pictures += shown(eval(compile(ast.Expression(last.value), name, "eval"), module))
    said = capsys.readouterr().out
    # Both runs, the refusal with its line, and the step have ended as the text says.
    assert said.count("Result(outcome='success'") == 3, said
    assert "<cell 3>:4: a Python `if`" in said and "'object': 'cup'" in said, said
    assert "_repr_svg_" in pictures and "_repr_html_" in pictures
    results = module["results"]
    assert isinstance(results, dict) and results["cdtn"].makespan_s < results["hsm"].makespan_s, results


@pytest.mark.skipif(importlib.util.find_spec("nbclient") is None, reason="no nbclient: only the newest interpreter has it")
def test_a_kernel_shows_a_chart(tmp_path: pathlib.Path) -> None:
    """In a kernel of Jupyter: tasks are traced from cells, and charts are displayed."""
    import nbclient
    import nbformat

    log = ROOT / "crates" / "report" / "src" / "fixtures" / "two_boxes.jsonl"
    task = "import ratn\nfrom ratn.actions import gripper\n\n@ratn.task\ndef t(n: int):\n    opened = gripper.release()\n\nt.to_yaml()"
    wrong = "@ratn.task\ndef u(n: int):\n    if n:\n        pass"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(text) for text in (task, wrong, f"ratn.Log({str(log)!r}).gantt()")])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3", allow_errors=True).execute()
    first, second, third = (cell["outputs"][0] for cell in notebook["cells"])
    assert "opened:" in first["data"]["text/plain"], first
    assert second["ename"] == "Untraceable" and ":3: a Python `if`" in second["evalue"], second
    assert third["data"]["image/svg+xml"].startswith("<svg") and third["data"]["text/html"].startswith("<svg"), third


@pytest.mark.skipif(sys.version_info < (3, 12), reason="older interpreters write signatures otherwise")
def test_the_reference_is_that_of_the_docstrings() -> None:
    written = (ROOT / "docs" / "python-reference.md").read_text()
    made = subprocess.run([sys.executable, str(pathlib.Path(__file__).with_name("reference.py"))], capture_output=True, text=True, check=True).stdout
    assert written == made, "make it anew: `python crates/python/tests/reference.py >docs/python-reference.md`, with the package installed"


def test_everything_public_says_what_it_is() -> None:
    silent = []
    for name in ratn.__all__:
        thing = getattr(ratn, name)
        if not (getattr(thing, "__doc__", None) or "").strip():
            silent.append(name)
        if isinstance(thing, type) and thing.__module__.startswith("ratn") and not issubclass(thing, (BaseException, dict)):
            members = {key: value for key, value in vars(thing).items() if not key.startswith("_") and (callable(value) or isinstance(value, (property, staticmethod)))}
            silent += [f"{name}.{key}" for key, value in members.items() if not (getattr(value, "__doc__", None) or "").strip()]
    assert not silent, silent
    assert os.path.exists(NOTEBOOK)


def test_the_task_of_the_documentation_runs(tmp_path: pathlib.Path) -> None:
    told = subprocess.run(
        [sys.executable, str(TESTS / "tasks" / "visiting.py")], cwd=tmp_path, capture_output=True, text=True, timeout=200
    )
    assert told.returncode == 0, told.stderr
    for part in ("Result(outcome='success', outputs={'seen': 2}", "/go (retired, success)", "waiting for"):
        assert part in told.stdout, told.stdout
    assert (tmp_path / "visiting.svg").read_text().startswith("<svg")


@pytest.mark.skipif(importlib.util.find_spec("rapidocr_onnxruntime") is None, reason="no rapidocr-onnxruntime: only the newest interpreter has it, where pip does")
def test_a_model_of_a_package_works_while_the_arm_moves(tmp_path: pathlib.Path) -> None:
    told = subprocess.run(
        [sys.executable, str(TESTS / "tasks" / "labels.py")], cwd=tmp_path, capture_output=True, text=True, timeout=200
    )
    assert told.returncode == 0, told.stderr
    assert "SCREWS" in told.stdout, told.stdout
    assert "'surely': 'yes'" in told.stdout, told.stdout
