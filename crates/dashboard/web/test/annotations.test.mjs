// What the page "Annotations" works out without a browser.

import assert from "node:assert/strict";
import { test } from "node:test";
import { begin, changesOf, completions, draftOf, gainText, inForce, isOther, maySave, sorted, wordsFor } from "../src/annotations.ts";

const key = (name, items = null) => ({ key: name, said: items !== null, items: items ?? [], listed: name !== "duration" });
const state = { path: "a/b", depth: 1, form: "action: x/y", line: 3, fixed: "", in_force: [], keys: [key("reads", ["at(table)"]), key("effects"), key("duration", ["2"])] };

test("only what is otherwise than the file is a change", () => {
  const draft = draftOf(state);
  assert.deepEqual(changesOf(state, draft), []);
  draft.get("reads").items.push("  ");
  assert.deepEqual(changesOf(state, draft), [], "an empty line counts for nothing");
  draft.get("reads").items[1] = " on(cup, table) ";
  draft.get("effects").said = true;
  draft.get("duration").items[0] = "";
  assert.deepEqual(changesOf(state, draft), [
    { key: "reads", items: ["at(table)", "on(cup, table)"] },
    { key: "effects", items: [] },
    { key: "duration", items: null },
  ]);
  draft.get("reads").said = false;
  assert.deepEqual(changesOf(state, draft)[0], { key: "reads", items: null });
  assert.deepEqual(state.keys[0].items, ["at(table)"], "what was read stays as it was");
});

test("findings stand under their key, at their state, or elsewhere", () => {
  const one = (path, name) => ({ severity: "error", rule: "r", path, key: name, line: 1, message: "m", help: "" });
  const { byKey, own, others } = sorted([one("a/b", "reads"), one("a/b", "reads"), one("a/b", "in"), one("a", "reads"), one("", "")], "a/b", ["reads", "effects"]);
  assert.deepEqual([byKey.get("reads").length, own.length, others.length], [2, 1, 2]);
});

test("the room of the world model that a state takes for what it reads is said beside its own resources", () => {
  const line = (name, text, from) => ({ key: name, text, from });
  const lines = [line("reads", "at(table)", "this state"), line("resources", "block Arm", "this state"), line("resources", "block WorldModel", "for what it reads")];
  assert.deepEqual(inForce(lines, "resources"), ["In force: block Arm (this state)", "In force: block WorldModel (for what it reads)"]);
  assert.deepEqual(inForce(lines, "effects"), []);
});

test("what is gained is said, and why it is not", () => {
  assert.match(gainText({ before_s: 56, after_s: 42, obstacle: "" }), /14.0\u00a0s shorter \(25.0\u00a0%\)/);
  assert.match(gainText({ before_s: 42, after_s: 56, obstacle: "" }), /14.0\u00a0s longer/);
  assert.match(gainText({ before_s: 42, after_s: 42, obstacle: "" }), /nothing is gained/);
  assert.match(gainText({ before_s: 42, after_s: null, obstacle: "it takes too long" }), /cannot be said: it takes too long. As it is: 42.0/);
});

test("what is refused cannot be saved, unless the file was refused before", () => {
  const [some, error, warning] = [[{ key: "reads", items: [] }], { severity: "error" }, { severity: "warning" }];
  assert.equal(maySave(some, { problem: "", refused: false }, []), true);
  assert.equal(maySave(some, { problem: "", refused: true }, [warning]), false);
  assert.equal(maySave(some, { problem: "", refused: true }, [warning, error]), true);
  assert.equal(maySave(some, { problem: "no value", refused: false }, [error]), false);
  assert.equal(maySave(some, null, [error]), false);
  assert.equal(maySave([], { problem: "", refused: false }, []), false);
});

test("what is typed while a change is saved is told from what was sent", () => {
  const sent = { digest: "1", state: "a", changes: [{ key: "reads", items: ["x"] }] };
  assert.equal(isOther(sent, { ...sent, digest: "2" }), false);
  assert.equal(isOther(sent, { ...sent, changes: [{ key: "reads", items: ["x", "y"] }] }), true);
  assert.equal(isOther(sent, { ...sent, changes: [] }), true);
  assert.equal(isOther(sent, { ...sent, state: "b", changes: [] }), false);
});

test("words are completed from the catalogue and the ontology", () => {
  const all = { kinds: ["Arm"], predicates: ["at(?)", "on(?, ?)"], entities: ["cup"], places: [] };
  assert.ok(wordsFor("resources", all).includes("{ block: Arm }"));
  assert.deepEqual(wordsFor("reads", all), ["scene", "at(?)", "on(?, ?)", "at(cup)"]);
  assert.ok(wordsFor("effects", all).includes("not at(cup)"));
  assert.deepEqual(wordsFor("computes", all), ["true", "false"]);
  assert.deepEqual(wordsFor("duration", all), []);
});

test("within a predicate's brackets the individuals of each place are offered", () => {
  const all = { kinds: [], predicates: ["at(?)", "on(?, ?)"], entities: ["cup", "table"], places: [] };
  assert.deepEqual(completions("reads", "", all), wordsFor("reads", all));
  assert.deepEqual(completions("reads", "at(", all), ["at(cup)", "at(table)", "at(?)"]);
  assert.deepEqual(completions("reads", "on(c", all), ["on(cup, ", "on(table, ", "on(?, "]);
  assert.deepEqual(completions("reads", "on(cup, ", all), ["on(cup, cup)", "on(cup, table)", "on(cup, ?)"]);
  assert.deepEqual(completions("reads", "on(cup,", all), ["on(cup, cup)", "on(cup, table)", "on(cup, ?)"]);
  assert.deepEqual(completions("reads", "on(cup,ta", all), ["on(cup,cup)", "on(cup,table)", "on(cup,?)"], "what was typed stays");
  assert.deepEqual(completions("requires", "exists on(cup, table) and at(", all), ["exists on(cup, table) and at(cup)", "exists on(cup, table) and at(table)"]);
  assert.deepEqual(completions("effects", "at(", all), ["at(cup)", "at(table)"]);
  assert.deepEqual(completions("effects", "not on(cup, ", all), ["not on(cup, cup)", "not on(cup, table)", "not on(cup, ?)"]);
  assert.deepEqual(completions("reads", "on(cup, table, ", all), [], "it has two places");
  assert.deepEqual(completions("reads", "compose(", all), wordsFor("reads", all), "no predicate");
});

test("a name that stands for predicates of one and of two places is completed to both", () => {
  const all = { kinds: [], predicates: ["in_gripper(?)", "in_gripper(?, ?)"], entities: ["box", "arm"], places: [] };
  assert.deepEqual(completions("effects", "in_gripper(", all), ["in_gripper(box)", "in_gripper(arm)", "in_gripper(box, ", "in_gripper(arm, "]);
  assert.deepEqual(completions("effects", "in_gripper(box, ", all), ["in_gripper(box, box)", "in_gripper(box, arm)"]);
  assert.deepEqual(completions("effects", "not in_gripper(box, a", all), ["not in_gripper(box, box)", "not in_gripper(box, arm)", "not in_gripper(box, ?)"]);
  assert.deepEqual(completions("effects", "in_gripper(box, arm, ", all), []);
});

test("at a place of a predicate stands what fits there, and what the file has there", () => {
  const places = [
    { predicate: "at(?)", offered: [["$box.id", "cup"]] },
    { predicate: "in_gripper(?, ?)", offered: [["$box.id", "cup"], ["$arm", "left"]] },
  ];
  const all = { kinds: [], predicates: ["at(?)", "in_gripper(?, ?)", "near(?, ?)"], entities: ["cup", "left"], places };
  assert.deepEqual(completions("effects", "in_gripper(", all), ["in_gripper($box.id, ", "in_gripper(cup, "]);
  assert.deepEqual(completions("effects", "in_gripper($box.id, ", all), ["in_gripper($box.id, $arm)", "in_gripper($box.id, left)"]);
  assert.deepEqual(completions("effects", "near(cup, ", all), ["near(cup, cup)", "near(cup, left)"]);
  assert.ok(wordsFor("reads", all).includes("at($box.id)"), "a dollar is no pattern");
  assert.ok(!wordsFor("reads", all).includes("at(left)"));
});

test("a key that is said from now on says something at once, and what was typed stays", () => {
  const of = (key, items) => (begin(key, items), items);
  assert.deepEqual(of("pia", [""]), ["true"], "its field was shown empty");
  assert.deepEqual(of("exceptional", []), ["aborted"]);
  assert.deepEqual(of("duration", [""]), [""]);
  assert.deepEqual(of("computes", ["false"]), ["false"]);
});
