"""Takes the spans that a run and its daemons send, as a collector does, and reads them with the opentelemetry-proto package.

    python check-exports-live.py RATN FOLDER
"""

import subprocess
import sys
import threading
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest, ExportTraceServiceResponse

ratn, folder = sys.argv[1:3]
requests = []


class Collector(BaseHTTPRequestHandler):
    def do_POST(self):
        assert self.path == "/v1/traces" and self.headers["content-type"] == "application/x-protobuf"
        request = ExportTraceServiceRequest()
        request.ParseFromString(self.rfile.read(int(self.headers["content-length"])))
        requests.append(request)
        answer = ExportTraceServiceResponse().SerializeToString()
        self.send_response(200)
        self.send_header("content-type", "application/x-protobuf")
        self.send_header("content-length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *_):
        pass


collector = ThreadingHTTPServer(("127.0.0.1", 0), Collector)
threading.Thread(target=collector.serve_forever, daemon=True).start()
with open("deploy/ratn.toml") as config, open(f"{folder}/live.toml", "w") as with_collector:
    endpoint = f"http://127.0.0.1:{collector.server_port}"
    with_collector.write(f'{config.read()}\n[service.otlp]\nendpoint = "{endpoint}"\n')
task = ["examples/fetch_boxes.yaml", "--set", "boxes=1", "--speed", "50"]
log = f"{folder}/live.jsonl"
run = [ratn, "run", *task, "--config", f"{folder}/live.toml", "--log", log]
subprocess.run(run, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

spans, services = [], Counter()
for request in requests:
    for field in request.DESCRIPTOR.fields:
        assert field.name == "resource_spans"
    for of_resource in request.resource_spans:
        service = next(a.value.string_value for a in of_resource.resource.attributes if a.key == "service.name")
        own = [span for scope in of_resource.scope_spans for span in scope.spans]
        services[service] += len(own)
        spans += own
assert all(len(s.trace_id) == 16 and len(s.span_id) == 8 for s in spans)
assert all(s.start_time_unix_nano <= s.end_time_unix_nano for s in spans)
root = next(s for s in spans if s.span_id == (1).to_bytes(8, "big"))
ids = {s.span_id for s in spans}
for span in spans:
    if span.trace_id == root.trace_id and span.span_id != root.span_id:
        assert span.parent_span_id in ids, f"{span.name} has no parent"
        assert all(link.span_id in ids for link in span.links), f"{span.name} is linked to nothing"
for service in ("ratn", "ratn-resource-manager", "ratn-world-pool", "ratn-cell", "ratn-worker"):
    assert services[service], f"no spans of {service}"
print(f"live: {len(spans)} spans in {len(requests)} requests: {dict(services)}")
