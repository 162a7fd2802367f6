// What is worked out before anything is painted. `scripts/build-dashboard` runs it; what pages look like is `scripts/check-dashboard`'s.

import assert from "node:assert/strict";
import { test } from "node:test";
import { pausesBefore } from "../src/breakpoints.ts";
import { Gantt } from "../src/gantt.ts";
import { Network } from "../src/network.ts";
import { waited } from "../src/say.ts";
import { Store, splitPath } from "../src/store.ts";

const instance = (id, path, more = {}) => ({
  id,
  path,
  state: path.replace(/\[[^\]]*\]/g, ""),
  stage: "retired",
  since_s: id,
  expanded_s: 0,
  speculative: false,
  reused: false,
  outcome: null,
  decision: null,
  phases: [],
  jobs: [],
  waits: [],
  edges: [],
  invalidations: [],
  ...more,
});

const job = (from_s, to_s, resources) => ({ action: "a/b", activity: "motion", attempt: 1, from_s, to_s, ending: "success", reason: "", worth: "used", resources });

function storeOf(instances, more = {}) {
  const store = new Store();
  store.apply({ epoch: 1, version: 1, fresh: true, more: false, run: { at_s: 1000, last_s: 1000, from_s: 0, pauses: [], absences: [] }, instances, gone: [], waiting: [], held: [], queue: [], kinds: [], ...more });
  return store;
}

const task = (flows) => ({ known: true, note: "", states: [], flows, stops: [] });

test("frames are put together, and a fresh one replaces everything", () => {
  const store = storeOf([instance(1, "a"), instance(2, "b")]);
  store.apply({ ...store.frame, fresh: false, instances: [instance(2, "b", { stage: "running" }), instance(3, "c")], gone: [1] });
  assert.deepEqual([...store.instances.values()].map((one) => `${one.path} ${one.stage}`), ["b running", "c retired"]);
  store.apply({ ...store.frame, fresh: true, instances: [instance(9, "z")], gone: [] });
  assert.deepEqual([...store.instances.keys()], [9]);
  store.apply({ ...store.frame, epoch: 2, fresh: false, instances: [], gone: [] });
  assert.equal(store.instances.size, 0);
});

test("an instance gets data from the visit of its own iteration, else from the youngest before it", () => {
  const store = storeOf([
    instance(1, "look"),
    instance(2, "each[0]/plan"),
    instance(3, "each[0]/move"),
    instance(4, "each[1]/plan"),
    instance(5, "each[1]/move"),
    instance(6, "each[0]/late"),
    instance(7, "end"),
  ]);
  store.setTask(task([{ from: "each/plan", to: "each/move", kind: "data" }, { from: "look", to: "each/plan", kind: "condition" }, { from: "each/plan", to: "each/late", kind: "data" }, { from: "each/move", to: "end", kind: "data" }]));
  const from = (id) => store.edges(store.instances.get(id)).map((edge) => `${edge.from} ${edge.kind}`);
  assert.deepEqual([3, 5, 2, 4, 6, 7, 1].map(from), [["2 data"], ["4 data"], ["1 condition"], ["1 condition"], ["2 data"], ["5 data"], []]);
});

test("what the log tells and what the task says is said once", () => {
  const store = storeOf([instance(1, "a"), instance(2, "b", { edges: [{ from: 1, kind: "data" }] })]);
  store.setTask(task([{ from: "a", to: "b", kind: "data" }]));
  assert.equal(store.edges(store.instances.get(2)).length, 1);
});

test("a key may have slashes and brackets", () => {
  assert.deepEqual(splitPath("each[a/b]/plan"), ["each[a/b]", "plan"]);
  assert.deepEqual(splitPath("a]/b"), ["a]", "b"]);
});

test("everything stands behind what it depended on, and nothing on anything else", () => {
  const store = storeOf([
    instance(1, "a"),
    instance(2, "b", { edges: [{ from: 1, kind: "data" }] }),
    // Who held a resource may be younger: that goes backwards.
    instance(3, "each[0]/c", { edges: [{ from: 2, kind: "world" }, { from: 4, kind: "resource" }] }),
    instance(4, "each[1]/c", { edges: [{ from: 3, kind: "resource" }] }),
    instance(5, "d"),
  ]);
  const network = new Network(store);
  network.layOut();
  const at = new Map(network.nodes.map((node) => [node.members[0].id, node]));
  for (const [before, after] of [[1, 2], [2, 3], [3, 4]]) assert.ok(at.get(before).x < at.get(after).x, `${before} ${after}`);
  assert.equal(at.get(3).y, at.get(4).y);
  assert.equal(new Set(network.nodes.map((node) => `${node.x} ${node.y}`)).size, 5);
});

test("what has not depended on anything stands behind what is before it in its visit, or behind the routine that it is in", () => {
  const store = storeOf([instance(1, "a"), instance(2, "routine", { edges: [{ from: 1, kind: "data" }] }), instance(3, "routine/x"), instance(4, "routine/y"), instance(5, "z")]);
  const network = new Network(store);
  network.layOut();
  const x = new Map(network.nodes.map((node) => [node.members[0].id, node.x]));
  for (const [before, after] of [[1, 2], [2, 3], [3, 4], [2, 5]]) assert.ok(x.get(before) < x.get(after), `${before} ${after}`);
});

test("a collapsed state stands for its visits, and only the causes of one are left", () => {
  const store = storeOf([instance(1, "a"), instance(2, "each[0]/b", { edges: [{ from: 1, kind: "data" }] }), instance(3, "each[0]/c", { edges: [{ from: 2, kind: "data" }] }), instance(4, "each[1]/b"), instance(5, "z")]);
  const network = new Network(store);
  network.collapsed.add("each");
  network.layOut();
  assert.deepEqual(network.nodes.map((node) => `${node.label} ${node.members.length}`), ["a 1", "each[0] 2", "each[1] 1", "z 1"]);
  network.collapsed.clear();
  store.selected = 3;
  network.causes = true;
  network.layOut();
  assert.deepEqual(network.nodes.map((node) => node.members[0].id), [1, 2, 3]);
  network.causes = false;
  network.search = "Z";
  network.layOut();
  assert.deepEqual(network.nodes.map((node) => node.label), ["z"]);
});

test("states that were not visited stand where the task file has them", () => {
  const store = storeOf([instance(1, "first")]);
  store.setTask({ ...task([{ from: "first", to: "last", kind: "data" }]), states: [{ path: "first", kind: "action" }, { path: "never", kind: "action" }, { path: "last", kind: "action" }] });
  const network = new Network(store);
  network.level = "states";
  network.layOut();
  assert.deepEqual(network.nodes.map((node) => `${node.label} ${node.members.length}`), ["first 1", "never 0", "last 0"]);
});

test("bars of one row that overlap are in lanes of their own", () => {
  const store = storeOf([instance(1, "a", { jobs: [job(0, 5, ["arm@sim"])] }), instance(2, "b", { jobs: [job(4, 9, ["arm@sim"])] }), instance(3, "c", { jobs: [job(5, 6, ["arm@sim", "eye@sim"])] })]);
  const gantt = new Gantt(store, "resource");
  gantt.layOut();
  assert.deepEqual(gantt.rows.map((row) => `${row.name} ${row.lanes} ${row.bars.map((bar) => bar.lane).join("")}`), ["arm@sim 2 010", "eye@sim 1 0"]);
  gantt.by = "host";
  gantt.layOut();
  assert.deepEqual(gantt.rows.map((row) => row.name), ["sim"]);
});

test("what was waited for longest is said first", () => {
  const one = instance(1, "a", {
    waits: [{ from_s: 1, to_s: 2, kinds: ["Arm"], behind: ["b had arm@sim"] }],
    phases: [{ stage: "waiting", from_s: 2, to_s: 9, awaited: "c" }, { stage: "running", from_s: 9, to_s: 99, awaited: "d" }],
  });
  assert.deepEqual(waited(one).map((line) => line.replaceAll("\u00a0", " ")), ["waited 7.0 s for c", "waited 1.0 s for Arm: b had arm@sim"]);
});

test("a breakpoint pauses before its state and what is inside of it, and before no other of a longer name", () => {
  assert.ok(pausesBefore(["for_box/grasp"], "for_box/grasp") && pausesBefore(["for_box"], "for_box/grasp"));
  assert.ok(!pausesBefore(["for_box/grasp"], "for_box") && !pausesBefore(["for_box"], "for_boxes/grasp") && !pausesBefore([], "a"));
});
