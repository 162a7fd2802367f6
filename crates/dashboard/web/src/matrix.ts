// Rigid motions and projections as 4 × 4 matrices in columns, as WebGL takes them; vectors of three numbers.

import type { Place } from "./wire";

export type Matrix = Float64Array;
export type Vector = readonly [number, number, number];

const number = (values: readonly number[], index: number, otherwise = 0): number => values[index] ?? otherwise;

export function identity(): Matrix {
  return matrix(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);
}

function matrix(...columns: number[]): Matrix {
  return Float64Array.from(columns);
}

/** First `b`, then `a`. */
export function compose(a: Matrix, b: Matrix): Matrix {
  const both = new Float64Array(16);
  for (let column = 0; column < 4; column += 1) {
    for (let row = 0; row < 4; row += 1) {
      let sum = 0;
      for (let k = 0; k < 4; k += 1) sum += (a[k * 4 + row] ?? 0) * (b[column * 4 + k] ?? 0);
      both[column * 4 + row] = sum;
    }
  }
  return both;
}

/** A rotation by a unit quaternion x, y, z, w, then a shift. */
export function rigid(position: readonly number[], quaternion: readonly number[]): Matrix {
  const [x, y, z, w] = [number(quaternion, 0), number(quaternion, 1), number(quaternion, 2), number(quaternion, 3, 1)];
  return matrix(
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0,
    number(position, 0), number(position, 1), number(position, 2), 1,
  );
}

export function placed(place: Place): Matrix {
  return rigid(place.position, place.quaternion);
}

/** About a unit vector, in radians. */
export function turned(axis: readonly number[], angle: number): Matrix {
  const [sin, cos] = [Math.sin(angle / 2), Math.cos(angle / 2)];
  return rigid([], [number(axis, 0) * sin, number(axis, 1) * sin, number(axis, 2) * sin, cos]);
}

export function scaled(a: Matrix, [x, y, z]: Vector): Matrix {
  return compose(a, matrix(x, 0, 0, 0, 0, y, 0, 0, 0, 0, z, 0, 0, 0, 0, 1));
}

export function shifted(a: Matrix, [x, y, z]: Vector): Matrix {
  return compose(a, matrix(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1));
}

export function origin(a: Matrix): Vector {
  return [a[12] ?? 0, a[13] ?? 0, a[14] ?? 0];
}

export const minus = (a: Vector, b: Vector): Vector => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const plus = (a: Vector, b: Vector, times = 1): Vector => [a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]];
export const length = (a: Vector): number => Math.hypot(...a);
export const cross = (a: Vector, b: Vector): Vector => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

export function unit(a: Vector): Vector {
  const long = length(a);
  return long === 0 ? [0, 0, 1] : [a[0] / long, a[1] / long, a[2] / long];
}

/** From one point to another, along z of what is drawn with it; its x and y have a width. */
export function along(from: Vector, to: Vector, width: number): Matrix {
  const way = minus(to, from);
  const z = unit(way);
  const x = unit(cross(Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], z));
  const y = cross(z, x);
  const middle = plus(from, way, 0.5);
  return scaled(matrix(...x, 0, ...y, 0, ...z, 0, ...middle, 1), [width, width, length(way)]);
}

/** What an eye sees that looks at a point, z upwards. */
export function looking(eye: Vector, at: Vector): Matrix {
  const back = unit(minus(eye, at));
  const right = unit(cross([0, 0, 1], back));
  const up = cross(back, right);
  const dot = (a: Vector) => -(a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2]);
  return matrix(
    right[0], up[0], back[0], 0,
    right[1], up[1], back[1], 0,
    right[2], up[2], back[2], 0,
    dot(right), dot(up), dot(back), 1,
  );
}

/** A view of so many radians from top to bottom. */
export function perspective(angle: number, aspect: number, near: number, far: number): Matrix {
  const f = 1 / Math.tan(angle / 2);
  return matrix(f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0);
}
