// Draws primitives and lines with WebGL 2. It knows nothing of robots: it is given shapes with their frames and colours.

import { type Matrix, type Vector, compose, identity, scaled, shifted } from "./matrix";

export type Colour = readonly [number, number, number];

/** A primitive, its axis along z, or a mesh in its bounding box: what `Shape` of the contract is, in the world. */
export interface Solid {
  kind: string;
  size: readonly number[];
  frame: Matrix;
  colour: Colour;
  /** Of a mesh its corners, as the program packs them. */
  corners?: ArrayBuffer;
}

/** Lines from each even point to the odd one behind it, in the world; three numbers a point. */
export interface Lines {
  points: Float32Array;
  colour: Colour;
}

const VERTEX = `#version 300 es
uniform mat4 view;
uniform mat4 frame;
uniform mat3 turn;
in vec3 point;
in vec3 normal;
out vec3 facing;
void main() {
  facing = turn * normal;
  gl_Position = view * frame * vec4(point, 1.0);
}`;

/** Light from above and from the side of the eye; lines have no side. A surface is seen from both sides, whichever its file takes for the outer one. */
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 colour;
uniform vec3 eye;
uniform bool lit;
in vec3 facing;
out vec4 painted;
void main() {
  float light = 1.0;
  if (lit) {
    vec3 n = normalize(facing);
    light = 0.5 + 0.25 * max(n.z, -0.4 * n.z) + 0.35 * abs(dot(n, eye));
  }
  painted = vec4(colour * light, 1.0);
}`;

const ROUND = 28;

/** Of a corner of a mesh that was packed: its bytes, and where its normal begins. */
const CORNER_BYTES = 12;
const NORMAL_AT = 8;

interface Mesh {
  vertices: WebGLVertexArrayObject;
  buffer: WebGLBuffer;
  count: number;
}

export class Painter {
  private readonly program: WebGLProgram;
  private readonly primitives: Record<string, Mesh>;
  /** Meshes that are on the graphics card. */
  private readonly loaded = new Map<ArrayBuffer, Mesh>();
  private readonly lines: { vertices: WebGLVertexArrayObject; buffer: WebGLBuffer };

  constructor(private readonly gl: WebGL2RenderingContext) {
    this.program = program(gl);
    this.primitives = { box: this.primitive(box()), cylinder: this.primitive(turnedAround(CYLINDER)), sphere: this.primitive(turnedAround(HALF_CIRCLE)) };
    const [vertices, buffer] = [gl.createVertexArray(), gl.createBuffer()];
    gl.bindVertexArray(vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    this.attribute("point", gl.FLOAT, 0, 12);
    this.lines = { vertices, buffer };
  }

  paint(view: Matrix, eye: readonly number[], background: Colour, solids: readonly Solid[], lines: readonly Lines[]): void {
    const gl = this.gl;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(this.at("view"), false, Float32Array.from(view));
    gl.uniform3f(this.at("eye"), eye[0] ?? 0, eye[1] ?? 0, eye[2] ?? 1);
    gl.uniform1i(this.at("lit"), 1);
    for (const solid of solids) this.solid(solid);
    gl.uniform1i(this.at("lit"), 0);
    gl.uniformMatrix4fv(this.at("frame"), false, Float32Array.from(identity()));
    gl.bindVertexArray(this.lines.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lines.buffer);
    for (const { points, colour } of lines) {
      gl.uniform3f(this.at("colour"), ...colour);
      gl.bufferData(gl.ARRAY_BUFFER, points, gl.DYNAMIC_DRAW);
      gl.drawArrays(gl.LINES, 0, points.length / 3);
    }
  }

  private solid({ kind, size, frame, colour, corners }: Solid): void {
    const [a, b, c] = [size[0] ?? 0, size[1] ?? 0, size[2] ?? 0];
    this.gl.uniform3f(this.at("colour"), ...colour);
    if (kind === "mesh") this.mesh(corners, frame, [a, b, c]);
    else if (kind === "box") this.draw("box", scaled(frame, [a, b, c]));
    else if (kind === "sphere") this.draw("sphere", scaled(frame, [a, a, a]));
    else this.draw("cylinder", scaled(frame, [a, a, b]));
    if (kind !== "capsule") return;
    for (const end of [-b / 2, b / 2]) this.draw("sphere", scaled(shifted(frame, [0, 0, end]), [a, a, a]));
  }

  private draw(primitive: string, frame: Matrix): void {
    const found = this.primitives[primitive];
    if (found !== undefined) this.triangles(found, frame, normals(frame));
  }

  /** Corners are parts of the bounding box; normals are in metres. */
  private mesh(corners: ArrayBuffer | undefined, frame: Matrix, size: Vector): void {
    if (corners === undefined) return;
    const known = this.loaded.get(corners) ?? this.load(corners);
    const box = scaled(frame, size);
    this.triangles(known, shifted(box, [-0.5, -0.5, -0.5]), normals(frame));
  }

  private triangles({ vertices, count }: Mesh, frame: Matrix, turn: Float32Array): void {
    const gl = this.gl;
    gl.uniformMatrix4fv(this.at("frame"), false, Float32Array.from(frame));
    gl.uniformMatrix3fv(this.at("turn"), false, turn);
    gl.bindVertexArray(vertices);
    gl.drawArrays(gl.TRIANGLES, 0, count);
  }

  /** Gives back the room of meshes that are not shown any more. */
  keepOnly(shown: ReadonlySet<ArrayBuffer>): void {
    for (const [corners, { vertices, buffer }] of this.loaded) {
      if (shown.has(corners)) continue;
      this.gl.deleteVertexArray(vertices);
      this.gl.deleteBuffer(buffer);
      this.loaded.delete(corners);
    }
  }

  private readonly places = new Map<string, WebGLUniformLocation | null>();
  private at(name: string): WebGLUniformLocation | null {
    let place = this.places.get(name);
    if (place === undefined) {
      place = this.gl.getUniformLocation(this.program, name);
      this.places.set(name, place);
    }
    return place;
  }

  private primitive(triangles: number[]): Mesh {
    const gl = this.gl;
    const mesh = this.stored(Float32Array.from(triangles), triangles.length / 6);
    this.attribute("point", gl.FLOAT, 0, 24);
    this.attribute("normal", gl.FLOAT, 12, 24);
    return mesh;
  }

  private load(corners: ArrayBuffer): Mesh {
    const gl = this.gl;
    const mesh = this.stored(corners, Math.floor(corners.byteLength / CORNER_BYTES));
    this.attribute("point", gl.UNSIGNED_SHORT, 0, CORNER_BYTES);
    this.attribute("normal", gl.BYTE, NORMAL_AT, CORNER_BYTES);
    this.loaded.set(corners, mesh);
    return mesh;
  }

  private stored(corners: ArrayBuffer | Float32Array<ArrayBuffer>, count: number): Mesh {
    const gl = this.gl;
    const [vertices, buffer] = [gl.createVertexArray(), gl.createBuffer()];
    gl.bindVertexArray(vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    return { vertices, buffer, count };
  }

  /** Whole numbers are parts of the greatest one of their kind. */
  private attribute(name: string, kind: number, offset: number, stride: number): void {
    const place = this.gl.getAttribLocation(this.program, name);
    this.gl.enableVertexAttribArray(place);
    this.gl.vertexAttribPointer(place, 3, kind, kind !== this.gl.FLOAT, stride, offset);
  }
}

function program(gl: WebGL2RenderingContext): WebGLProgram {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]] as const) {
    const shader = gl.createShader(kind);
    if (shader === null) throw new Error("the browser gives no shader");
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (gl.getProgramParameter(made, gl.LINK_STATUS) !== true) throw new Error(gl.getProgramInfoLog(made) ?? "the shaders do not link");
  return made;
}

/** What turns normals where a frame turns and scales along its own axes. */
function normals(frame: Matrix): Float32Array {
  const turn = new Float32Array(9);
  for (let column = 0; column < 3; column += 1) {
    const axis = [frame[column * 4] ?? 0, frame[column * 4 + 1] ?? 0, frame[column * 4 + 2] ?? 0];
    const square = axis.reduce((sum, value) => sum + value * value, 0);
    axis.forEach((value, row) => (turn[column * 3 + row] = square === 0 ? 0 : value / square));
  }
  return turn;
}

/** A cube of edge 1: points with their normals, three to a triangle. */
function box(): number[] {
  const triangles: number[] = [];
  for (let axis = 0; axis < 3; axis += 1) {
    for (const side of [-0.5, 0.5]) {
      const normal = [0, 0, 0];
      normal[axis] = 2 * side;
      for (const [u, v] of [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]] as const) {
        const point = [0, 0, 0];
        [point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3]] = [side, u, v];
        triangles.push(...point, ...normal);
      }
    }
  }
  return triangles;
}

/** Sections of what is turned around z: from radius and height to radius and height, with the normal at both. */
type Section = readonly [number, number, readonly [number, number], number, number, readonly [number, number]];

const CYLINDER: Section[] = [
  [0, -0.5, [0, -1], 1, -0.5, [0, -1]],
  [1, -0.5, [1, 0], 1, 0.5, [1, 0]],
  [1, 0.5, [0, 1], 0, 0.5, [0, 1]],
];

const HALF_CIRCLE: Section[] = Array.from({ length: ROUND / 2 }, (_, step): Section => {
  const at = (n: number): [number, number] => [Math.cos(((2 * n) / ROUND - 0.5) * Math.PI), Math.sin(((2 * n) / ROUND - 0.5) * Math.PI)];
  const [from, to] = [at(step), at(step + 1)];
  return [...from, from, ...to, to];
});

function turnedAround(sections: readonly Section[]): number[] {
  const triangles: number[] = [];
  for (let step = 0; step < ROUND; step += 1) {
    const [a, b] = [step, step + 1].map((n) => (2 * Math.PI * n) / ROUND) as [number, number];
    for (const [r0, z0, n0, r1, z1, n1] of sections) {
      const corner = (angle: number, radius: number, height: number, [out, up]: readonly [number, number]) => [
        radius * Math.cos(angle), radius * Math.sin(angle), height,
        out * Math.cos(angle), out * Math.sin(angle), up,
      ];
      const [p, q, r, s] = [corner(a, r0, z0, n0), corner(b, r0, z0, n0), corner(b, r1, z1, n1), corner(a, r1, z1, n1)];
      triangles.push(...p, ...q, ...r, ...p, ...r, ...s);
    }
  }
  return triangles;
}

/** The edges of a primitive: of a box all twelve, else its rims and some lines along it. */
export function outline(kind: string, size: readonly number[], frame: Matrix): number[] {
  const [a, b, c] = [size[0] ?? 0, size[1] ?? 0, size[2] ?? 0];
  const ends: [number, number, number][] = [];
  if (kind === "box") {
    for (const [x, y] of [[-1, -1], [-1, 1], [1, -1], [1, 1]] as const) {
      ends.push([(x * a) / 2, (y * b) / 2, -c / 2], [(x * a) / 2, (y * b) / 2, c / 2]);
      ends.push([-a / 2, (x * b) / 2, (y * c) / 2], [a / 2, (x * b) / 2, (y * c) / 2]);
      ends.push([(x * a) / 2, -b / 2, (y * c) / 2], [(x * a) / 2, b / 2, (y * c) / 2]);
    }
  } else {
    for (let step = 0; step < ROUND; step += 1) {
      const at = (n: number) => [a * Math.cos((2 * Math.PI * n) / ROUND), a * Math.sin((2 * Math.PI * n) / ROUND)] as const;
      for (const z of [-b / 2, b / 2]) ends.push([...at(step), z], [...at(step + 1), z]);
      if (step % (ROUND / 4) === 0) ends.push([...at(step), -b / 2], [...at(step), b / 2]);
    }
  }
  return ends.flatMap((end) => [...compose(frame, shifted(identity(), end)).slice(12, 15)]);
}
