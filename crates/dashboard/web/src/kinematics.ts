// Where the links of a robot are, from the positions of its joints.

import { type Matrix, compose, identity, placed, shifted, turned } from "./matrix";
import type { Link, Robot } from "./wire";

/** Of each link its frame in the world; a position for each joint. */
export function forward(robot: Robot, positions: readonly number[]): Matrix[] {
  const frames: Matrix[] = [];
  for (const link of robot.links) {
    const parent = link.parent === null ? undefined : frames[link.parent];
    frames.push(compose(parent ?? identity(), inParent(link, positions)));
  }
  return frames;
}

function inParent(link: Link, positions: readonly number[]): Matrix {
  const at = placed(link.at);
  if (link.joint === null) return at;
  const moved = link.factor * (positions[link.joint] ?? 0);
  const [x, y, z] = [link.axis[0] ?? 0, link.axis[1] ?? 0, link.axis[2] ?? 0];
  return link.slides ? shifted(at, [x * moved, y * moved, z * moved]) : compose(at, turned(link.axis, moved));
}
