"""Reads the exports of an event log with readers that are not ours, and compares what they say with the log.

    python check-exports.py LOG FOLDER       with FOLDER/run.{perfetto,otlp,mcap,csv}
"""

import base64
import csv
import json
import sys
from collections import Counter, defaultdict

log_file, folder = sys.argv[1:3]
lines = [json.loads(line) for line in open(log_file)]
starts = [line for line in lines if line.get("command") == "start"]
expanded = {line["instance"]: line["path"] for line in lines if line.get("note") == "expanded"}
grants = [resource["id"] for line in lines if line.get("event") == "granted" for resource in line["lease"]["resources"]]
began_ns = lines[0].get("origin", {}).get("began_unix_ms", 0) * 1_000_000


def perfetto():
    from google.protobuf.unknown_fields import UnknownFieldSet
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent

    trace = Trace()
    trace.ParseFromString(open(f"{folder}/run.perfetto", "rb").read())
    tracks = {p.track_descriptor.uuid: p.track_descriptor for p in trace.packet if p.HasField("track_descriptor")}
    for packet in trace.packet:
        for message in (packet, packet.track_event, packet.track_descriptor, *packet.track_event.debug_annotations):
            assert len(UnknownFieldSet(message)) == 0, "a field that the schema does not have"
    names = {t.name for t in tracks.values()}
    assert {grant for grant in grants} - {"world-model@compute"} <= names | {"world-model@compute"}, names
    # Slices of a track are within each other, and all end.
    events = sorted(
        ((p.timestamp, i, p.track_event) for i, p in enumerate(trace.packet) if p.HasField("track_event")),
        key=lambda e: (e[0], e[1]),
    )
    open_slices, work, flows = defaultdict(list), [], defaultdict(list)
    for at, _, event in events:
        assert event.track_uuid in tracks, "an event of a track that is not described"
        stack = open_slices[event.track_uuid]
        if event.type == TrackEvent.TYPE_SLICE_BEGIN:
            stack.append(event.name)
            if "work" in event.categories:
                work.append((event.name, at))
            for flow in event.terminating_flow_ids:
                flows[flow].append(("to", at, event.name))
        elif event.type == TrackEvent.TYPE_SLICE_END:
            assert stack, f"an end without a beginning on {tracks[event.track_uuid].name}"
            stack.pop()
        else:
            for flow in event.flow_ids:
                flows[flow].append(("from", at, event.name))
    left = {tracks[uuid].name: stack for uuid, stack in open_slices.items() if stack}
    assert not left, f"slices that do not end: {left}"
    expected = Counter((f"{expanded[s['instance']]} {s['goal']['provider']}/{s['goal']['action']}", began_ns + s["at"]) for s in starts)
    assert Counter(work) == expected, (Counter(work) - expected, expected - Counter(work))
    whole = [ends for ends in flows.values() if [end[0] for end in ends] == ["from", "to"]]
    assert whole and len(whole) >= 0.8 * len(flows), flows
    print(f"run.perfetto: {len(trace.packet)} packets, {len(tracks)} tracks, {len(work)} jobs, {len(whole)} flows")


def otlp():
    from google.protobuf import json_format
    from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

    def ids_as_protobuf_has_them(value):
        # OTLP/JSON writes ids in hex; protobuf's own JSON in base64.
        if isinstance(value, dict):
            ids = ("traceId", "spanId", "parentSpanId")
            return {
                k: base64.b64encode(bytes.fromhex(v)).decode() if k in ids else ids_as_protobuf_has_them(v)
                for k, v in value.items()
            }
        return [ids_as_protobuf_has_them(v) for v in value] if isinstance(value, list) else value

    spans = []
    for line in open(f"{folder}/run.otlp"):
        request = ExportTraceServiceRequest()
        json_format.ParseDict(ids_as_protobuf_has_them(json.loads(line)), request)
        spans += [s for r in request.resource_spans for scope in r.scope_spans for s in scope.spans]
    by_id = {span.span_id: span for span in spans}
    assert len(by_id) == len(spans), "two spans with one id"
    assert all(len(s.trace_id) == 16 and len(s.span_id) == 8 for s in spans)
    roots = [s for s in spans if not s.parent_span_id]
    assert len(roots) == 1 and roots[0].name == lines[0]["task"]
    for span in spans:
        assert not span.parent_span_id or span.parent_span_id in by_id, f"{span.name} has no parent"
        assert span.start_time_unix_nano <= span.end_time_unix_nano
        for link in span.links:
            assert link.span_id in by_id, f"{span.name} is linked to nothing"
    names = Counter(s.name for s in spans if s.parent_span_id == roots[0].span_id)
    assert names == Counter(expanded.values()), "an instance without a span"
    jobs = Counter(s.name for s in spans if "ratn.attempt" in {a.key for a in s.attributes})
    assert jobs == Counter(f"{s['goal']['provider']}/{s['goal']['action']}" for s in starts)
    links = sum(len(s.links) for s in spans)
    assert links, "nothing waited for anything"
    print(f"run.otlp: {len(spans)} spans, {links} links")


def mcap():
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with open(f"{folder}/run.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary.statistics.message_count == sum(summary.statistics.channel_message_counts.values())
        topics = {c.topic: c for c in summary.channels.values()}
        schemas = {t: summary.schemas[c.schema_id].name for t, c in topics.items()}
        assert schemas == {
            "/log": "foxglove.Log",
            "/scene": "foxglove.SceneUpdate",
            "/tf": "foxglove.FrameTransforms",
            "/joint_states": "foxglove.JointStates",
            "/event_log": "ratn.LogLine",
        }, schemas
        seen = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=["/event_log"])]
        assert len(seen) == len(lines) and [s["at"] for s in seen] == sorted(l["at"] for l in lines)
        decoded = list(reader.iter_decoded_messages(topics=["/log", "/scene", "/tf", "/joint_states"]))
        counts = Counter(channel.topic for _, channel, _, _ in decoded)
        assert counts["/log"] >= 2 * len(starts)
        joints = [(m.log_time, d) for _, c, m, d in decoded if c.topic == "/joint_states"]
        followed = [s for s in starts if any("trajectory" in v for v in s["goal"]["inputs"].values() if isinstance(v, dict))]
        for start in followed:
            trajectory = next(v["trajectory"] for v in start["goal"]["inputs"].values() if "trajectory" in v)
            first = next(d for at, d in joints if at == began_ns + start["at"])
            told = {j.name: j.position for j in first.joints}
            assert told == dict(zip(trajectory["joints"], trajectory["points"][0]["positions"])), told
        shown = {e.id for _, c, _, d in decoded if c.topic == "/scene" for e in d.entities}
        shaped = {
            change["set"]["fact"]["arguments"][0]
            for line in lines if line.get("command") == "commit"
            for change in line["changes"] if "set" in change and change["set"]["fact"]["predicate"] == "shape"
        }
        assert shown >= {name if isinstance(name, str) else str(name) for name in shaped} or not shaped, (shown, shaped)
    print(f"run.mcap: {dict(counts)}, {len(followed)} trajectories, objects {sorted(shown)}")


def table():
    rows = list(csv.DictReader(open(f"{folder}/run.csv", newline="")))
    assert Counter(row["path"] for row in rows) == Counter(expanded.values())
    assert sum(int(row["attempts"]) for row in rows) == len(starts)
    print(f"run.csv: {len(rows)} rows")


perfetto()
otlp()
mcap()
table()
