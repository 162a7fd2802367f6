"""Spans of workers in Python at an OpenTelemetry collector."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NamedTuple

import pytest
from conftest import PYTHON, Place, template

WORKER = """
import pathlib
import ratn

w = ratn.Worker("looker", kind="Looker")


@w.action(outputs={"threads": "any"}, computes=True, reads=[])
def look(goal: ratn.Goal) -> dict:
    return {"threads": [(one / "comm").read_text().strip() for one in pathlib.Path("/proc/self/task").iterdir()]}


w.run()
"""
TASK = """
task: looks
outputs:
  threads: { type: any, value: it.threads }
states:
  - it: { action: looker/look, computes: true, reads: [], resources: [Looker] }
"""


class Span(NamedTuple):
    service: str
    instance: str
    trace: bytes
    id: bytes
    parent: bytes
    name: str


def fields(message: bytes) -> Iterator[tuple[int, bytes]]:
    """The fields of a protobuf message that are of bytes."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(message):
        tag = varint()
        if tag & 7 == 2:
            length = varint()
            yield tag >> 3, message[at : at + length]
            at += length
        elif tag & 7 == 0:
            varint()
        else:
            assert tag & 7 in (1, 5), f"no field of protobuf: {tag}"
            at += 8 if tag & 7 == 1 else 4


def inside(message: bytes, *path: int) -> list[bytes]:
    """What is at a path of numbers of fields."""
    found = [message]
    for number in path:
        found = [value for one in found for own, value in fields(one) if own == number]
    return found


def spans(request: bytes) -> Iterator[Span]:
    """Of an ExportTraceServiceRequest."""
    for of_resource in inside(request, 1):
        about = {inside(one, 1)[0]: inside(one, 2, 1)[0].decode() for one in inside(of_resource, 1, 1)}
        for span in inside(of_resource, 2, 2):
            one = dict(fields(span))
            service, instance = about[b"service.name"], about.get(b"service.instance.id", "")
            yield Span(service, instance, one[1], one[2], one.get(4, b""), one[5].decode())


class Collector:
    """Keeps the spans that it is sent."""

    def __init__(self) -> None:
        self.spans: list[Span] = []
        own = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                own.spans.extend(spans(body))
                self.send_response(200)
                self.send_header("content-length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.server.server_port}"


@pytest.fixture
def collector() -> Iterator[Collector]:
    collector = Collector()
    yield collector
    collector.server.shutdown()
    collector.server.server_close()


def looks(place: Place, otlp: str) -> list[str]:
    """Runs the task in a system; the names of the threads of the worker."""
    place.write("looker.py", WORKER)
    worker = template("looker", "Looker", python="looker.py", interpreter=PYTHON)
    config = place.write("system.toml", f'catalogues = ["built-in"]\n{otlp}[process-manager]\nhost = "compute"\n{worker}')
    with place.up(config):
        ended = place.run(place.write("looks.yaml", TASK))
        assert ended["outcome"] == "success", f"{ended['reason']}\n{ended['stderr']}\n{place.logs()}"
        return ended["outputs"]["threads"]


def exported(place: Place) -> dict[str, tuple[str, str]]:
    """The ids of the trace and of the span, by the name of the span, as `ratn export otlp` writes them of the only log."""
    to = place.folder / "looks.otlp"
    done = place.ratn("export", "otlp", place.folder / "looks-1.jsonl", "-o", to)
    assert done.returncode == 0, done.stderr
    requests = [json.loads(line) for line in to.read_text().splitlines()]
    return {
        span["name"]: (span["traceId"], span["spanId"])
        for request in requests
        for of_resource in request["resourceSpans"]
        for of_scope in of_resource["scopeSpans"]
        for span in of_scope["spans"]
    }


def test_a_goal_of_a_worker_in_python_is_a_span_in_the_trace_of_its_run(place: Place, collector: Collector) -> None:
    threads = looks(place, f'[service.otlp]\nendpoint = "{collector.endpoint}"\n')
    assert "otlp" in threads, threads

    def of_worker() -> list[Span]:
        return [span for span in collector.spans if span.service == "ratn-worker" and span.instance.startswith("looker")]

    until = time.monotonic() + 10
    while not of_worker() and time.monotonic() < until:
        time.sleep(0.05)
    (goal,) = [span for span in of_worker() if span.name == "ratn.v1.ActionService/Execute"]
    (node,) = [span for span in collector.spans if span.service == "ratn" and span.name == "it"]
    assert (goal.trace, goal.parent) == (node.trace, node.id), collector.spans
    # What was sent while it ran, and the export of its log, are one trace.
    assert exported(place) == {span.name: (span.trace.hex(), span.id.hex()) for span in collector.spans if span.service == "ratn"}


def test_without_a_collector_a_worker_has_no_thread_for_spans(place: Place) -> None:
    assert "otlp" not in looks(place, "")
