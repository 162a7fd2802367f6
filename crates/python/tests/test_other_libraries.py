"""Plain gRPC clients and workers, of grpcio and of grpc-js, with every setting as it is by default."""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess

import pytest
from conftest import PYTHON, ROOT, TESTS, Place, template

# A server of gRPC's C library closes a connection at the third ping within five minutes: the first ones came after 5, 10, 15 and 20 s.
LONG_S = 27.0
NODE_MODULES = os.environ.get("NODE_PATH")

CATALOGUE = """
[catalogue.resources.Foreign]
class = "process"
count = 1
[catalogue.resources.Other]
class = "process"
count = 1
[catalogue.providers.foreign]
resource = "Foreign"
[catalogue.providers.foreign.actions.wait]
inputs = { seconds = "float" }
outputs = { by = "string" }
[catalogue.providers.other]
resource = "Other"
[catalogue.providers.other.actions.wait]
inputs = { seconds = "float" }
outputs = { by = "string" }
"""

TASK = """
task: waits
outputs:
  first: { type: string, value: first.by }
  second: { type: string, value: second.by }
states:
  - first:
      action: PROVIDER/wait
      in: { seconds: 0.01 }
      computes: true
      reads: []
      resources: [KIND]
  - second:
      action: PROVIDER/wait
      in: { seconds: SECONDS }
      computes: true
      reads: []
      resources: [KIND]
"""


@pytest.fixture(scope="module")
def protos(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """What `protoc` makes of the project's files for Python."""
    folder = tmp_path_factory.mktemp("protos")
    files = sorted(str(file.relative_to(ROOT / "proto")) for file in (ROOT / "proto").glob("ratn/v1/*.proto"))
    command = [PYTHON, "-m", "grpc_tools.protoc", f"-I{ROOT / 'proto'}", f"--python_out={folder}", f"--grpc_python_out={folder}"]
    subprocess.run([*command, *files], check=True)
    return folder


def without_sdk() -> None:
    pytest.importorskip("grpc", reason="grpcio is not installed")
    pytest.importorskip("grpc_tools", reason="grpcio-tools is not installed")


def with_node() -> None:
    if not shutil.which("node") or not NODE_MODULES:
        pytest.skip("node or @grpc/grpc-js is not there")


def performs(place: Place, provider: str, kind: str, program: str, args: list[str], seconds: float) -> dict:
    config = place.write(
        "system.toml",
        'catalogues = ["built-in"]\n[process-manager]\nhost = "compute"\n'
        + template(provider, kind, program=program, args=args, pass_env=["NODE_PATH"], start_timeout_s=30)
        + CATALOGUE,
    )
    text = TASK.replace("PROVIDER", provider).replace("KIND", kind).replace("SECONDS", str(seconds))
    with place.up(config, "--speed", "1"):
        return place.run(place.write("waits.yaml", text), timeout=seconds + 60)


def test_a_worker_of_plain_grpcio_performs_a_goal_that_is_longer_than_its_patience_with_pings(place: Place, protos: pathlib.Path) -> None:
    without_sdk()
    args = [str(TESTS / "other" / "worker.py"), "{endpoint_file}", str(protos)]
    ended = performs(place, "foreign", "Foreign", PYTHON, args, LONG_S)
    assert ended["outcome"] == "success", f"{ended}\n{place.logs()}"
    assert ended["outputs"] == {"first": "grpcio", "second": "grpcio"}


def test_a_worker_of_plain_grpc_js_performs_goals(place: Place) -> None:
    with_node()
    args = [str(TESTS / "other" / "worker.js"), "{endpoint_file}", str(ROOT / "proto")]
    ended = performs(place, "other", "Other", shutil.which("node") or "", args, 0.1)
    assert ended["outcome"] == "success", f"{ended}\n{place.logs()}"
    assert ended["outputs"] == {"first": "grpc-js", "second": "grpc-js"}


def test_plain_clients_are_answered_at_the_default_socket(place: Place, protos: pathlib.Path) -> None:
    without_sdk()
    config = place.write("system.toml", 'catalogues = ["built-in"]\n[process-manager]\nhost = "compute"\n')
    with place.up(config):
        address = f"unix:{place.runtime / 'resource-manager.sock'}"
        asks = (
            f"import sys; sys.path.insert(0, {str(protos)!r}); import grpc\n"
            "from ratn.v1 import resources_pb2 as r, resources_pb2_grpc as g\n"
            f"client = g.ResourceServiceStub(grpc.insecure_channel({address!r}))\n"
            "for resource in client.List(r.ListRequest(), timeout=10).resources: print(resource.kind)\n"
        )
        answered = subprocess.run([PYTHON, "-c", asks], capture_output=True, text=True, timeout=60)
        assert answered.returncode == 0, answered.stderr
        assert "arm" in answered.stdout.lower(), answered.stdout
        if NODE_MODULES and shutil.which("node"):
            command = ["node", str(TESTS / "other" / "client.js"), address, str(ROOT / "proto")]
            other = subprocess.run(command, capture_output=True, text=True, timeout=60)
            assert other.returncode == 0, other.stderr
            assert other.stdout == answered.stdout
