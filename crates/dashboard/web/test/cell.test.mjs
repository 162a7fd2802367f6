// Where links and joints are at a moment, without a browser.

import assert from "node:assert/strict";
import { test } from "node:test";
import { Clock, Film, between } from "../src/film.ts";
import { forward } from "../src/kinematics.ts";
import { Looks } from "../src/looks.ts";
import { along, compose, identity, origin, shifted, turned } from "../src/matrix.ts";
import { outline } from "../src/webgl.ts";

const place = (position = [0, 0, 0], quaternion = [0, 0, 0, 1]) => ({ position, quaternion });
const link = (name, parent, more = {}) => ({ name, parent, at: place(), joint: null, axis: [0, 0, 1], slides: false, factor: 1, shapes: [], visuals: [], ...more });
const close = (found, expected) => expected.forEach((value, index) => assert.ok(Math.abs(found[index] - value) < 1e-9, `${found} is not ${expected}`));

/** An upper arm of 1 m that turns about z, a forearm of 0.5 m that turns the same way, two fingers of which one mimics the other. */
const robot = {
  known: true,
  name: "two",
  note: "",
  lacks: [],
  links: [
    link("root", null),
    link("upper", 0, { at: place([0, 0, 1]), joint: 0 }),
    link("fore", 1, { at: place([1, 0, 0]), joint: 1 }),
    link("tool", 2, { at: place([0.5, 0, 0]) }),
    link("left", 3, { joint: 2, axis: [0, 1, 0], slides: true }),
    link("right", 3, { joint: 2, axis: [0, 1, 0], slides: true, factor: -1 }),
  ],
  joints: [
    { name: "shoulder", slides: false, start: 0 },
    { name: "elbow", slides: false, start: 0.5 },
    { name: "finger", slides: true, start: 0.05 },
  ],
  tools: [3],
};

const point = (after_s, positions, velocities = []) => ({ after_s, positions, velocities });
const track = (id, joints, from_s, points, more = {}) => ({ id, joints, from_s, until_s: null, estimated: false, path: `state ${id}`, points, ...more });

function filmOf(...tracks) {
  const film = new Film();
  film.take({ epoch: 1, version: 1, fresh: true, tracks, kept: tracks.map(({ id }) => id) });
  return film;
}

test("links are where their joints and their parents bring them, and a mimic goes with its joint", () => {
  close(origin(forward(robot, [0, 0, 0])[3]), [1.5, 0, 1]);
  const quarter = Math.PI / 2;
  close(origin(forward(robot, [quarter, 0, 0])[3]), [0, 1.5, 1]);
  close(origin(forward(robot, [quarter, -quarter, 0])[3]), [0.5, 1, 1]);
  const [left, right] = forward(robot, [0, 0, 0.04]).slice(4).map(origin);
  close(left, [1.5, 0.04, 1]);
  close(right, [1.5, -0.04, 1]);
});

test("between two points a joint goes straight, or as their speeds say", () => {
  const straight = [point(0, [1]), point(2, [3])];
  assert.deepEqual([-1, 0, 0.5, 2, 9].map((after) => between(straight, 0, after)), [1, 1, 1.5, 3, 3]);
  // At rest at both ends it is slower there, and as far in the middle.
  const resting = [point(0, [0], [0]), point(2, [1], [0])];
  close([between(resting, 0, 0.5), between(resting, 0, 1), between(resting, 0, 1.5)], [0.15625, 0.5, 0.84375]);
  // A cubic is met exactly: t³ from 1 to 2.
  close([between([point(1, [1], [3]), point(2, [8], [12])], 0, 1.5)], [3.375]);
  assert.equal(between([], 0, 1), null);
});

test("the latest motion that has begun counts, and one that was ended stays where it was", () => {
  const film = filmOf(track(1, [0, 1], 1, [point(0, [0, 0]), point(2, [2, 4])], { until_s: 2 }), track(2, [0], 5, [point(0, [9])], { until_s: 5 }));
  assert.deepEqual(film.at(robot, 0.5), [0, 0.5, 0.05], "before it, the joints are where they start");
  assert.deepEqual(film.at(robot, 1.5), [0.5, 1, 0.05]);
  assert.deepEqual(film.at(robot, 4), [1, 2, 0.05], "it was ended after a second");
  assert.deepEqual(film.at(robot, 6), [9, 2, 0.05]);
  assert.deepEqual([film.knows(2, 9), film.knows(1, 0.5), film.knows(1, 1)], [false, false, true]);
  assert.deepEqual([film.moving(1.5), film.moving(3), film.moving(5)].map((all) => all.map(({ id }) => id)), [[1], [], []]);
});

test("a motion of which only the end is known begins where the joint was", () => {
  const film = filmOf(track(1, [0], 0, [point(0, [1])], { until_s: 0 }), track(2, [0], 2, [point(4, [3], [0])], { estimated: true }));
  close([2, 4, 6, 8].map((moment) => film.at(robot, moment)[0]), [1, 2, 3, 3]);
});

test("tracks are told once, changed when they end, and forgotten when the server forgets them", () => {
  const film = filmOf(track(1, [0], 0, [point(0, [0]), point(4, [4])]), track(2, [1], 0, [point(0, [7])]));
  film.take({ epoch: 1, version: 2, fresh: false, tracks: [track(1, [0], 0, [point(0, [0]), point(4, [4])], { until_s: 1 })], kept: [1] });
  assert.deepEqual(film.at(robot, 3), [1, 0.5, 0.05]);
  film.take({ epoch: 2, version: 1, fresh: true, tracks: [], kept: [] });
  assert.deepEqual(film.at(robot, 3), [0, 0.5, 0.05]);
});

test("what is shown glides to what was told, and a jump back is made at once", () => {
  const clock = new Clock();
  clock.tell(10, 1000, false);
  assert.equal(clock.at(1000), 10);
  clock.tell(11, 1100, true);
  assert.deepEqual([clock.at(1100), clock.at(1150), clock.at(1200), clock.at(1900)], [10, 10.5, 11, 11]);
  assert.deepEqual([clock.runs(1150), clock.runs(1200)], [true, false]);
  clock.tell(4, 1300, true);
  assert.equal(clock.at(1300), 4);
});

test("a rod goes from one point to the other, and an outline has the edges of its shape", () => {
  const rod = along([1, 2, 3], [1, 2, 5], 0.1);
  close(origin(rod), [1, 2, 4]);
  close(origin(compose(rod, shifted(identity(), [0, 0, 0.5]))), [1, 2, 5]);
  const box = outline("box", [2, 4, 6], turned([0, 0, 1], Math.PI / 2));
  assert.equal(box.length, 12 * 2 * 3);
  close([Math.max(...box.filter((_, index) => index % 3 === 0)), Math.max(...box.filter((_, index) => index % 3 === 1))], [2, 1]);
});

test("a robot is drawn as it is seen, with its meshes when they are there, or as what of it can collide", async () => {
  const shape = (kind, at) => ({ kind, size: [1, 2, 3], at: place(at) });
  const visuals = [
    { shape: shape("box", [1, 0, 0]), mesh: null, colour: [1, 0, 0] },
    { shape: shape("mesh", [0, 1, 0]), mesh: 4, colour: null },
    { shape: shape("mesh", [0, 2, 0]), mesh: 4, colour: null },
    { shape: shape("mesh", [0, 3, 0]), mesh: 5, colour: null },
  ];
  const seen = { ...robot, links: [link("root", null, { shapes: [shape("sphere")], visuals }), link("bare", 0, { shapes: [shape("box")] })] };
  const corners = new ArrayBuffer(36);
  const asked = [];
  let arrived = 0;
  const ask = async (mesh) => {
    asked.push(mesh);
    if (mesh === 5) throw new Error("it is gone");
    return corners;
  };
  const looks = new Looks(ask, () => (arrived += 1));
  const frames = [shifted(identity(), [0, 0, 7]), identity()];
  const kinds = () => looks.solids(seen, frames, [0.5, 0.5, 0.5]).map(({ kind }) => kind);
  const loading = looks.take(seen);
  assert.deepEqual(kinds(), ["box"], "meshes are on their way");
  await loading;
  assert.deepEqual([asked, arrived, looks.problem], [[4, 5], 1, "A mesh is not there: it is gone"], "each is asked for once");
  const [box, mesh] = looks.solids(seen, frames, [0.5, 0.5, 0.5]);
  assert.deepEqual([kinds(), box.colour, mesh.colour], [["box", "mesh", "mesh"], [1, 0, 0], [0.5, 0.5, 0.5]]);
  assert.equal(mesh.corners, corners);
  close(origin(mesh.frame), [0, 1, 7]);
  looks.collides = true;
  assert.deepEqual(kinds(), ["sphere", "box"]);
  // One whose description says nothing of it is drawn so in any case, and another robot's meshes are forgotten.
  looks.collides = false;
  await looks.take(robot);
  assert.deepEqual([looks.areKnown(robot), looks.loaded.size, looks.problem], [false, 0, ""]);
  assert.deepEqual(looks.solids({ ...robot, links: [link("only", null, { shapes: [shape("sphere")] })] }, [identity()], [0, 0, 0]).map(({ kind }) => kind), ["sphere"]);
});
