// The cell in 3D, in a file of its own that is loaded when its page is opened: the robot, what is believed, what is, and where it goes.

import { api } from "./api";
import { type Child, count, fill, h, seconds, table } from "./dom";
import { Clock, Film, lasts } from "./film";
import { forward } from "./kinematics";
import { Looks } from "./looks";
import { type Matrix, type Vector, along, compose, identity, length, minus, origin, placed, plus, shifted } from "./matrix";
import { Orbit, whole } from "./orbit";
import type { Site } from "./pages";
import { type Colour, type Lines, Painter, type Solid, outline } from "./webgl";
import type { Cell, Object as Thing, Robot, Shape, Track, Truth } from "./wire";

/** Places of the tool between which its path is drawn straight. */
const STEPS = 80;
/** A tool that goes less far has no path. */
const LEAST_PATH_M = 0.005;
/** The list beside the canvas is made anew no more often. */
const LIST_MS = 400;
/** What has an edge as long is furniture. */
const FURNITURE_M = 0.5;
/** The floor is drawn so far, with a line for each half metre. */
const FLOOR_M = 3;
/** An outline stands out from what is solid at the same place. */
const AROUND_M = 0.006;
const KEYS = "Arrow keys turn it, Shift and arrow keys move, plus and minus zoom, 0 shows all. What it shows is listed beside it.";
const NO_WEBGL = "This browser draws no 3D view: it has no WebGL 2, or that is switched off. What would be shown is listed.";

/** A path that is known of a track. */
interface Path {
  /** Which robot and which point of the film it was worked out for. */
  of: string;
  tools: Vector[][];
}

export class CellView {
  private readonly film = new Film();
  private readonly clock = new Clock();
  private readonly canvas = h("canvas", { tabindex: 0, role: "application", "aria-label": `The cell in 3D. ${KEYS}` });
  private readonly box = h("div", { class: "canvas" }, this.canvas);
  private readonly note = h("p", { class: "warn", hidden: true });
  private readonly side = h("aside", { "aria-label": "What is shown" });
  private readonly orbit: Orbit;
  private painter: Painter | null = null;
  private readonly context: WebGL2RenderingContext | null;
  private robot: Robot | null = null;
  private cell: Cell | null = null;
  private objects: Thing[] = [];
  private untold = 0;
  private log: number | null = null;
  private dirty = false;
  private listed = 0;
  private listedOf: { cell: Cell | null; moment: number } | null = null;
  private paths = new Map<number, Path>();
  private readonly looks = new Looks((mesh) => api.mesh(this.log ?? 0, mesh), () => this.repaint());
  private readonly collides: HTMLButtonElement;

  constructor(
    private readonly element: HTMLElement,
    private readonly site: Site,
  ) {
    const show = (text: string, act: () => void, label = text) => h("button", { "aria-label": label, onclick: act }, text);
    this.collides = h("button", { hidden: true, "aria-pressed": "false", onclick: () => this.turnOver() }, "What can collide");
    const bar = h(
      "div",
      { class: "row" },
      show("+", () => this.orbit.zoom(1.25), "Zoom in"),
      show("−", () => this.orbit.zoom(1 / 1.25), "Zoom out"),
      show("All of it", () => this.orbit.fit()),
      this.collides,
      this.note,
    );
    const legend = h("div", { class: "legend below" }, h("span", {}, "solid: as believed"), h("span", {}, "outlined: as it is"), h("span", {}, "line: the way of what moves"));
    legend.append(h("span", { class: "more" }, "drag turns, Shift and drag moves, the wheel zooms"));
    this.element.append(h("div", { class: "stage" }, bar, this.box, legend), this.side);
    this.orbit = new Orbit(this.canvas, () => this.repaint(), () => this.middle());
    this.context = this.canvas.getContext("webgl2", { antialias: true });
    if (this.context === null) {
      this.canvas.remove();
      this.box.append(h("p", { id: "no-webgl" }, NO_WEBGL));
    } else this.painter = new Painter(this.context);
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.painter = null;
    });
    this.canvas.addEventListener("webglcontextrestored", () => {
      if (this.context !== null) this.painter = new Painter(this.context);
      this.repaint();
    });
    new ResizeObserver(() => this.repaint()).observe(this.box);
  }

  /** Asks for what has changed, up to the moment that is shown. */
  async follow(): Promise<void> {
    const log = this.site.log();
    if (log === null) return;
    if (log !== this.log) {
      this.log = log;
      this.film.clear();
      this.paths.clear();
      [this.cell, this.objects, this.robot] = [null, [], null];
    }
    const robot = this.robot ?? (await api.robot(log));
    if (log !== this.log) return;
    if (robot !== this.robot) void this.looks.take(robot);
    this.robot = robot;
    // One that is not known may be known when the page is opened again.
    const frame = this.site.store.frame;
    const epoch = frame?.epoch ?? 0;
    const cell = await api.cell(log, this.site.moment(), epoch, this.film.epoch === epoch ? this.film.version : 0);
    if (log !== this.site.log()) return;
    const isFirst = this.cell === null;
    this.film.take(cell);
    this.cell = cell;
    if (cell.objects !== null) [this.objects, this.untold] = [cell.objects, cell.untold];
    this.clock.tell(cell.at_s, performance.now(), !isFirst && !cell.fresh && (this.site.plays() || this.site.moment() === null));
    if (isFirst) this.orbit.fit();
    this.repaint();
  }

  begin(): void {
    if (this.robot?.known === false) this.robot = null;
    this.listedOf = null;
    this.repaint();
  }

  repaint(): void {
    if (this.dirty) return;
    this.dirty = true;
    requestAnimationFrame(() => {
      this.dirty = false;
      const now = performance.now();
      const moment = this.clock.at(now);
      if (!this.element.isConnected) return;
      this.paint(moment);
      // Whoever turns the view does not change what is listed.
      const isOther = this.listedOf === null || this.listedOf.cell !== this.cell || this.listedOf.moment !== moment;
      if (isOther && (now - this.listed > LIST_MS || !this.clock.runs(now))) {
        [this.listed, this.listedOf] = [now, { cell: this.cell, moment }];
        this.list(moment);
      }
      if (this.clock.runs(now)) this.repaint();
    });
  }

  private turnOver(): void {
    this.looks.collides = !this.looks.collides;
    this.collides.setAttribute("aria-pressed", String(this.looks.collides));
    this.repaint();
  }

  /** The robot at a moment, if it is known and the log is one of it. */
  private frames(moment: number): { robot: Robot; frames: Matrix[]; positions: number[] } | null {
    const robot = this.robot;
    if (robot === null || !robot.known || this.cell?.fits !== true) return null;
    const positions = this.film.at(robot, moment);
    return { robot, frames: forward(robot, positions), positions };
  }

  private paint(moment: number): void {
    const [painter, context] = [this.painter, this.context];
    const { clientWidth: width, clientHeight: height } = this.box;
    if (painter === null || context === null || width === 0 || height === 0) return;
    const began = performance.now();
    const [w, t] = [width, height].map((length) => Math.round(length * devicePixelRatio)) as [number, number];
    if (this.canvas.width !== w || this.canvas.height !== t) [this.canvas.width, this.canvas.height] = [w, t];
    const colour = (name: string) => parsed(this.site.colour(name));
    const solids: Solid[] = [];
    const lines: Lines[] = [floor(colour("line"))];
    const shown = this.frames(moment);
    const tool = this.tool(shown?.robot ?? null, shown?.frames ?? []);
    if (shown !== null) solids.push(...this.looks.solids(shown.robot, shown.frames, colour("cell-robot")));
    const meshes = solids.filter(({ kind }) => kind === "mesh").length;
    painter.keepOnly(this.looks.loaded);
    if (shown === null && this.cell !== null) lines.push(...axes(placed(this.cell.base), colour));
    for (const object of this.objects) {
      const at = placed(object.shape.at);
      if (object.held && tool === null) continue;
      const frame = object.held && tool !== null ? compose(tool, at) : at;
      const { kind, size } = object.shape;
      const large = Math.max(...size) >= FURNITURE_M;
      solids.push({ kind, size, frame, colour: colour(object.held ? "cell-held" : large ? "cell-furniture" : "cell-object") });
    }
    const outlines = this.truth().flatMap((object) => outline(object.shape.kind, object.shape.size.map((edge) => edge + AROUND_M), placed(object.shape.at)));
    lines.push({ points: Float32Array.from(outlines), colour: colour("cell-truth") });
    if (shown !== null) solids.push(...this.ways(shown.robot, moment, colour("cell-path")));
    painter.paint(this.orbit.view(w / t), this.orbit.back, colour("paper"), solids, lines);
    this.canvas.dataset["paintedMs"] = (performance.now() - began).toFixed(1);
    this.canvas.dataset["solids"] = String(solids.length);
    this.canvas.dataset["meshes"] = String(meshes);
    this.canvas.dataset["moment"] = moment.toFixed(3);
  }

  private truth(): Thing[] {
    // What is told with the newest is how things are now, and not what they were at another moment.
    return this.site.moment() === null ? (this.cell?.truth?.objects ?? []) : [];
  }

  private tool(robot: Robot | null, frames: Matrix[]): Matrix | null {
    const link = robot?.tools[0];
    return link === undefined ? null : (frames[link] ?? null);
  }

  /** The ways of the tools that something moves, as rods between places on it. */
  private ways(robot: Robot, moment: number, colour: Colour): Solid[] {
    const width = this.orbit.distance * 0.0022;
    const moving = this.film.moving(moment);
    this.paths = new Map(moving.map((track) => [track.id, this.path(robot, track)]));
    return [...this.paths.values()].flatMap(({ tools }) => tools).flatMap((places) =>
      places.slice(1).map((to, index): Solid => ({ kind: "cylinder", size: [1, 1], frame: along(places[index] ?? to, to, width), colour })),
    );
  }

  private path(robot: Robot, track: Track): Path {
    const of = `${track.until_s} ${this.film.epoch}`;
    const known = this.paths.get(track.id);
    if (known !== undefined && known.of === of) return known;
    const long = lasts(track);
    const tools: Vector[][] = robot.tools.map(() => []);
    for (let step = 0; step <= STEPS; step += 1) {
      const frames = forward(robot, this.film.at(robot, track.from_s + (long * step) / STEPS));
      robot.tools.forEach((link, arm) => tools[arm]?.push(origin(frames[link] ?? identity())));
    }
    const far = (places: Vector[]) => places.slice(1).reduce((sum, to, index) => sum + length(minus(to, places[index] ?? to)), 0);
    return { of, tools: tools.filter((places) => far(places) > LEAST_PATH_M) };
  }

  /** Where to look so that everything is in view. */
  private middle(): { at: Vector; distance: number } | null {
    const shown = this.frames(this.clock.at(performance.now()));
    const places: Vector[] = [];
    const add = (frame: Matrix, { kind, size }: Shape) => {
      const [a, b] = [size[0] ?? 0, size[1] ?? 0];
      const radius = kind === "box" ? Math.hypot(...size) / 2 : a + b / 2;
      // What reaches far along one axis does so along one alone: most of its sphere is empty.
      for (const way of [-0.7, 0.7]) places.push(plus(origin(frame), [radius, radius, radius], way));
    };
    if (this.cell !== null) places.push(origin(placed(this.cell.base)));
    for (const { held, shape } of this.objects) if (!held) add(placed(shape.at), shape);
    shown?.robot.links.forEach((link, index) => {
      for (const shape of link.shapes) add(compose(shown.frames[index] ?? identity(), placed(shape.at)), shape);
    });
    if (places.length < 2) return null;
    const bound = (axis: 0 | 1 | 2, pick: (...all: number[]) => number) => places.map((place) => place[axis]).reduce((a, b) => pick(a, b));
    const [low, high] = [Math.min, Math.max].map((pick): Vector => [bound(0, pick), bound(1, pick), bound(2, pick)]) as [Vector, Vector];
    const at: Vector = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2];
    return { at, distance: Math.min(Math.max(whole(length(minus(high, low)) / 2), 1), 40) };
  }

  private list(moment: number): void {
    const { robot, cell } = this;
    if (cell === null) {
      fill(this.side, h("p", { class: "faint" }, "Nothing is known yet."));
      return;
    }
    const shown = this.frames(moment);
    const notes = [cell.note, robot?.known === false && cell.note !== robot.note ? robot.note : ""].filter((text) => text !== "");
    const text = notes.length === 0 ? "" : `${notes.join("; ")}${shown === null ? ": only objects and the base are shown" : ""}`;
    this.note.hidden = text === "";
    if (this.note.textContent !== text) this.note.textContent = text;
    this.collides.hidden = shown === null || !this.looks.areKnown(shown.robot);
    const held = this.objects.filter((object) => object.held);
    fill(
      this.side,
      h("h2", {}, `The cell at ${seconds(moment)}`),
      ...(shown === null ? [h("p", {}, `The robot is not shown. The base is at ${where(cell.base.position)}.`)] : this.robotList(shown, moment)),
      cell.from_s > 0 && h("p", { class: "warn", id: "read-from" }, `The log was read from ${seconds(cell.from_s)} on: what was moved between the start and then is shown where it was at the start.`),
      held.length > 0 && h("p", {}, `Held: ${held.map((object) => object.name).join(", ")}`),
      table("Objects as believed", ["object", "where", "size"], this.objects.map((object) => thing(object))),
      this.untold > 0 && h("p", { class: "warn" }, `${count(this.untold)} more objects are not shown.`),
      ...truthList(this.site.moment() === null ? cell.truth : null, this.objects),
    );
  }

  private robotList({ robot, frames, positions }: { robot: Robot; frames: Matrix[]; positions: number[] }, moment: number): Child[] {
    const moving = this.film.moving(moment);
    const item = (track: Track) => h("li", {}, `${track.path}, until ${seconds(track.from_s + lasts(track))}${track.estimated ? ": the times in between are not in the log" : ""}`);
    const tools = robot.tools.map((link) => where(origin(frames[link] ?? identity())));
    const row = (name: string, index: number): Child[] => {
      const slides = robot.joints[index]?.slides === true;
      const value = positions[index] ?? 0;
      const said = this.film.knows(index, moment);
      return [name, slides ? `${metres(value)}` : `${Math.round((value * 180) / Math.PI)}°`, said ? "the log" : "assumed"];
    };
    return [
      h("p", {}, `${robot.name}, ${robot.note}. Joints are as commanded.`),
      ...[...robot.lacks, this.looks.problem].filter((text) => text !== "").map((text) => h("p", { class: "warn" }, `Not seen of it: ${text}`)),
      h("p", {}, `The tool is at ${tools.join("; ")}. The base is at ${where(this.cell?.base.position ?? [])}.`),
      h("h2", {}, "What moves"),
      moving.length === 0 ? h("p", { class: "faint" }, "Nothing moves.") : h("ul", { class: "plain", id: "moving" }, ...moving.map(item)),
      table("Joints", ["joint", "position", "from"], robot.joints.map((joint, index) => row(joint.name, index)), [1]),
    ];
  }
}

function truthList(truth: Truth | null, believed: Thing[]): Child[] {
  if (truth === null) return [];
  if (truth.problem !== "") return [h("p", { class: "warn" }, truth.problem)];
  const near = (object: Thing) => {
    const at = object.shape.at.position;
    const away = believed.filter((one) => !one.held).map((one) => Math.hypot(...at.map((value, axis) => value - (one.shape.at.position[axis] ?? 0))));
    const least = Math.min(...away);
    return Number.isFinite(least) ? metres(least) : "";
  };
  return [table("Objects as they are", ["object", "where", "size", "to the nearest believed"], truth.objects.map((object) => [...thing(object), near(object)]), [3])];
}

const METRES = new Intl.NumberFormat(navigator.language, { minimumFractionDigits: 2, maximumFractionDigits: 2, signDisplay: "negative" });
const metres = (value: number) => `${METRES.format(value)}\u00a0m`;
const where = (position: readonly number[]) => position.map((value) => METRES.format(value)).join(" / ");

function thing(object: Thing): Child[] {
  const { kind, size, at } = object.shape;
  return [object.name, object.held ? "held" : where(at.position), `${kind === "box" ? "" : `${kind} `}${where(size)}`];
}

/** `rgb(r, g, b)`, as browsers write colours. */
function parsed(text: string): Colour {
  const [r, g, b] = (text.match(/[\d.]+/g) ?? []).map((part) => Number(part) / 255);
  return [r ?? 0.5, g ?? 0.5, b ?? 0.5];
}

function floor(colour: Colour): Lines {
  const points: number[] = [];
  for (let at = -FLOOR_M; at <= FLOOR_M; at += 0.5) points.push(at, -FLOOR_M, 0, at, FLOOR_M, 0, -FLOOR_M, at, 0, FLOOR_M, at, 0);
  return { points: Float32Array.from(points), colour };
}

/** Where a base stands whose form is not known: x in red, y in green, z in blue. */
function axes(frame: Matrix, colour: (name: string) => Colour): Lines[] {
  const line = (to: Vector, name: string): Lines => ({ points: Float32Array.from([...origin(frame), ...origin(shifted(frame, to))]), colour: colour(name) });
  return [line([0.4, 0, 0], "bad"), line([0, 0.4, 0], "good"), line([0, 0, 0.4], "accent")];
}
