// The network: instances, or the states as their author wrote them, and on whom each depended.
//
// A row is a state, in the order of the hierarchy; from left to right everything stands behind what it depended on. A collapsed state
// stands for all that is inside it.

import { pausesBefore } from "./breakpoints";
import { DASHES, count } from "./dom";
import { hint, lastName, parent } from "./say";
import { type Store, splitPath } from "./store";
import { colour } from "./theme";
import { type Painter, fitted } from "./view";
import type { Instance } from "./wire";

export const KINDS = ["data", "world", "resource", "condition"] as const;
export type Kind = (typeof KINDS)[number];
export type Level = "instances" | "states";

export interface Node {
  key: string;
  label: string;
  /** The state that is its row. */
  row: string;
  members: Instance[];
  x: number;
  y: number;
}

interface Link {
  from: Node;
  to: Node;
  kind: Kind;
  times: number;
}

const WIDE = 150;
const TALL = 30;
const GAP_X = 46;
const GAP_Y = 14;
const MARGIN = 20;

export class Network implements Painter {
  level: Level = "instances";
  readonly shown = new Set<Kind>(KINDS);
  readonly collapsed = new Set<string>();
  search = "";
  stages: "all" | "open" | "waiting" = "all";
  /** Only what led to the instance that is chosen. */
  causes = false;
  nodes: Node[] = [];
  /** Every state that has something inside it. */
  groups: string[] = [];
  private links: Link[] = [];
  private rows: string[] = [];
  private byInstance = new Map<number, Node>();
  private laidOut = "";
  private scale = 1;
  private left = 0;
  private top = 0;
  private size = { width: 1, height: 1 };
  private fits = true;
  /** What is brought into the middle at the next painting. */
  private wanted: number | null = null;

  constructor(private readonly store: Store) {}

  /** The state under which it is shown: itself, or the outermost one around it that is collapsed. */
  private shownAs(path: string, state: string): { path: string; state: string } {
    if (this.collapsed.size === 0) return { path, state };
    const states = state.split("/");
    const paths = splitPath(path);
    for (let depth = 1; depth < states.length; depth += 1) {
      const outer = states.slice(0, depth).join("/");
      if (this.collapsed.has(outer)) return { path: paths.slice(0, depth).join("/"), state: outer };
    }
    return { path, state };
  }

  layOut(): void {
    const chosen = this.causes ? this.store.selected : null;
    const key = [this.store.generation, this.level, this.store.task?.known, [...this.shown], [...this.collapsed], this.search, this.stages, chosen].join("|");
    if (key === this.laidOut) return;
    this.laidOut = key;
    const instances = [...this.store.instances.values()].sort((a, b) => a.id - b.id);
    this.groups = [...new Set(instances.flatMap((one) => outer(one.state)))].sort();
    const wanted = chosen === null ? null : this.causesOf(chosen);
    const search = this.search.toLowerCase();
    const fits = (one: Instance) =>
      (wanted === null || wanted.has(one.id)) &&
      (search === "" || one.path.toLowerCase().includes(search)) &&
      (this.stages === "all" ||
        (this.stages === "open"
          ? one.stage !== "retired" && one.stage !== "squashed"
          : one.stage === "waiting" || one.stage === "asking" || one.stage === "preparing"));
    const nodes = new Map<string, Node>();
    this.byInstance = new Map();
    for (const one of instances) {
      if (!fits(one)) continue;
      const { path, state } = this.shownAs(one.path, one.state);
      // Two visits of the same path on two branches are two instances.
      const name = this.level === "states" ? state : path === one.path ? `${path}#${one.id}` : path;
      let node = nodes.get(name);
      if (node === undefined) {
        node = { key: name, label: lastName(this.level === "states" ? state : path), row: state, members: [], x: 0, y: 0 };
        nodes.set(name, node);
      }
      node.members.push(one);
      this.byInstance.set(one.id, node);
    }
    this.nodes = this.level === "states" && wanted === null ? this.asWritten(nodes, search) : [...nodes.values()];
    this.link();
    this.placeAll();
  }

  /** In the order of the task file, those that were not visited included. */
  private asWritten(nodes: Map<string, Node>, search: string): Node[] {
    const all = new Map<string, Node>();
    for (const { path } of this.store.task?.states ?? []) {
      const { state } = this.shownAs(path, path);
      const isWanted = this.stages === "all" && path.toLowerCase().includes(search);
      const node = nodes.get(state) ?? { key: state, label: lastName(state), row: state, members: [], x: 0, y: 0 };
      if (nodes.has(state) || isWanted) all.set(state, node);
    }
    for (const [state, node] of nodes) all.set(state, node);
    return [...all.values()];
  }

  private link(): void {
    const links = new Map<string, Link>();
    for (const node of this.nodes) {
      for (const one of node.members) {
        for (const edge of this.store.edges(one)) {
          const from = this.byInstance.get(edge.from);
          const kind = edge.kind as Kind;
          if (from === undefined || from === node || !this.shown.has(kind)) continue;
          const key = `${from.key}\n${node.key}\n${kind}`;
          const link = links.get(key);
          if (link === undefined) links.set(key, { from, to: node, kind, times: 1 });
          else link.times += 1;
        }
      }
    }
    if (this.level === "states") {
      const byRow = new Map(this.nodes.map((node) => [node.row, node]));
      for (const flow of this.store.task?.flows ?? []) {
        const from = byRow.get(this.shownAs(flow.from, flow.from).state);
        const to = byRow.get(this.shownAs(flow.to, flow.to).state);
        const kind = flow.kind as Kind;
        if (from === undefined || to === undefined || from === to || !this.shown.has(kind)) continue;
        const key = `${from.key}\n${to.key}\n${kind}`;
        if (!links.has(key)) links.set(key, { from, to, kind, times: 0 });
      }
    }
    this.links = [...links.values()];
  }

  private placeAll(): void {
    const order = new Map(this.nodes.map((node, index) => [node, index]));
    const into = new Map<Node, Node[]>();
    for (const { from, to } of this.links) {
      // A younger one that held a resource stands where it is: nothing goes in circles.
      if ((order.get(from) ?? 0) >= (order.get(to) ?? 0)) continue;
      const list = into.get(to);
      if (list === undefined) into.set(to, [from]);
      else list.push(from);
    }
    const rows = new Map<string, number>();
    for (const node of this.nodes) if (!rows.has(node.row)) rows.set(node.row, 0);
    // States that stand in the same state are beside each other, in the order in which they came first.
    const first = new Map<string, number>();
    this.nodes.forEach((node, index) => {
      for (const name of [...outer(node.row), node.row]) if (!first.has(name)) first.set(name, index);
    });
    const rank = (row: string) => [...outer(row), row].map((name) => first.get(name) ?? 0);
    const ranks = new Map([...rows.keys()].map((row) => [row, rank(row)]));
    this.rows = [...rows.keys()].sort((a, b) => compare(ranks.get(a) ?? [], ranks.get(b) ?? []) || (a < b ? -1 : 1));
    this.rows.forEach((row, index) => rows.set(row, index));
    const columns = new Map<Node, number>();
    const last = new Map<string, number>();
    // Of what has not depended on anything yet the place in the program is known: behind what stands before it in the same visit.
    const siblings = new Map<string, number>();
    // What a routine does stands behind the routine.
    const around = new Map<string, number>();
    for (const node of this.nodes) {
      let column = (last.get(node.row) ?? -1) + 1;
      const visit = this.level === "states" ? parent(node.row) : splitPath(node.members[0]?.path ?? "").slice(0, -1).join("/");
      const before = into.get(node);
      if (before === undefined) column = Math.max(column, (siblings.get(visit) ?? around.get(visit) ?? -1) + 1);
      else for (const from of before) column = Math.max(column, (columns.get(from) ?? 0) + 1);
      columns.set(node, column);
      siblings.set(visit, column);
      around.set(this.level === "states" ? node.row : (node.members[0]?.path ?? ""), column);
      last.set(node.row, column);
      node.x = MARGIN + column * (WIDE + GAP_X);
      node.y = MARGIN + (rows.get(node.row) ?? 0) * (TALL + GAP_Y);
    }
  }

  /** It, and everything that led to it. */
  private causesOf(id: number): Set<number> {
    const found = new Set([id]);
    const open = [id];
    for (let next = open.pop(); next !== undefined; next = open.pop()) {
      const one = this.store.instances.get(next);
      for (const edge of one === undefined ? [] : this.store.edges(one)) {
        if (!found.has(edge.from) && this.shown.has(edge.kind as Kind)) {
          found.add(edge.from);
          open.push(edge.from);
        }
      }
    }
    return found;
  }

  paint(context: CanvasRenderingContext2D, width: number, height: number): void {
    this.size = { width, height };
    this.layOut();
    if (this.fits) this.fit();
    if (this.wanted !== null) this.centre(this.wanted);
    this.wanted = null;
    context.save();
    context.translate(this.left, this.top);
    context.scale(this.scale, this.scale);
    const view = {
      left: -this.left / this.scale,
      right: (width - this.left) / this.scale,
      top: -this.top / this.scale,
      bottom: (height - this.top) / this.scale,
    };
    this.paintRows(context, view);
    this.paintLinks(context, view);
    const chosen = this.store.selected === null ? undefined : this.byInstance.get(this.store.selected);
    context.font = "13px system-ui, sans-serif";
    context.textBaseline = "middle";
    for (const node of this.nodes) {
      if (node.x > view.right || node.x + WIDE < view.left || node.y > view.bottom || node.y + TALL < view.top) continue;
      this.paintNode(context, node, node === chosen);
    }
    context.restore();
  }

  private paintRows(context: CanvasRenderingContext2D, view: { left: number; right: number; top: number; bottom: number }): void {
    let before = "";
    this.rows.forEach((row, index) => {
      const y = MARGIN + index * (TALL + GAP_Y) - GAP_Y / 2;
      const group = parent(row);
      if (y > view.bottom || y + TALL + GAP_Y < view.top) {
        before = group;
        return;
      }
      if (group !== before) {
        context.fillStyle = colour("line");
        context.fillRect(view.left, y, view.right - view.left, 1 / this.scale);
        if (group !== "" && this.scale > 0.5) {
          context.fillStyle = colour("faint");
          context.font = "11px system-ui, sans-serif";
          context.textBaseline = "top";
          context.fillText(group, Math.max(view.left + 6 / this.scale, 2), y + 1);
        }
      }
      before = group;
    });
  }

  private paintLinks(context: CanvasRenderingContext2D, view: { left: number; right: number; top: number; bottom: number }): void {
    const chosen = this.store.selected === null ? undefined : this.byInstance.get(this.store.selected);
    // So many curves cannot be told apart, nor painted while somebody drags.
    const straight = this.links.length > 3_000;
    for (const kind of KINDS) {
      if (!this.shown.has(kind)) continue;
      const path = new Path2D();
      const strong = new Path2D();
      for (const { from, to, kind: of } of this.links) {
        if (of !== kind) continue;
        const [x1, y1, x2, y2] = [from.x + WIDE, from.y + TALL / 2, to.x, to.y + TALL / 2];
        if (Math.max(x1, x2) < view.left || Math.min(x1, x2) > view.right) continue;
        if (Math.max(y1, y2) < view.top || Math.min(y1, y2) > view.bottom) continue;
        const into = from === chosen || to === chosen ? strong : path;
        into.moveTo(x1, y1);
        if (straight) into.lineTo(x2, y2);
        else {
          const bend = Math.max(30, Math.min(Math.abs(x2 - x1) / 2, 120));
          into.bezierCurveTo(x1 + bend, y1, x2 - bend, y2, x2, y2);
        }
        if (this.scale > 0.4 && !straight) {
          into.moveTo(x2 - 7, y2 - 4);
          into.lineTo(x2, y2);
          into.lineTo(x2 - 7, y2 + 4);
        }
      }
      context.strokeStyle = colour(kind);
      context.setLineDash(straight ? [] : (DASHES[kind] ?? []));
      context.lineWidth = Math.max(1.2, 0.6 / this.scale);
      context.globalAlpha = chosen === undefined ? (straight ? 0.35 : 0.85) : 0.3;
      context.stroke(path);
      context.globalAlpha = 1;
      context.lineWidth = Math.max(2.6, 1.2 / this.scale);
      context.stroke(strong);
    }
    context.setLineDash([]);
  }

  private paintNode(context: CanvasRenderingContext2D, node: Node, isChosen: boolean): void {
    const none = node.members.length === 0;
    const all = (stage: string) => node.members.every((member) => member.stage === stage);
    const some = (stage: string) => node.members.some((member) => member.stage === stage);
    const activity = node.members.flatMap((member) => member.jobs.slice(-1)).at(-1)?.activity;
    const waits = some("asking") || (some("waiting") && this.store.frame?.waiting.some((wait) => this.byInstance.get(wait.id) === node));
    context.globalAlpha = !none && all("squashed") ? 0.35 : 1;
    context.fillStyle = colour(activity ?? "idle");
    if (this.scale < 0.25) {
      context.fillRect(node.x, node.y, WIDE, TALL);
      if (isChosen) {
        context.strokeStyle = colour("accent");
        context.lineWidth = 3 / this.scale;
        context.strokeRect(node.x, node.y, WIDE, TALL);
      }
      context.globalAlpha = 1;
      return;
    }
    context.beginPath();
    context.roundRect(node.x, node.y, WIDE, TALL, 6);
    context.fill();
    const open = node.members.some((member) => member.stage !== "retired" && member.stage !== "squashed");
    context.setLineDash(node.members.some((member) => member.speculative) && open ? [5, 4] : []);
    context.lineWidth = isChosen ? 4 : waits || some("running") ? 2.5 : 1;
    context.strokeStyle = colour(isChosen ? "accent" : waits ? "warn" : some("running") ? "good" : "faint");
    context.stroke();
    context.setLineDash([]);
    if (this.scale > 0.45) {
      const stops = this.store.run?.breakpoints ?? [];
      const pauses = pausesBefore(stops, node.row) || node.members.some((one) => pausesBefore(stops, one.state)) ? "● " : "";
      const mark = none ? "" : some("running") ? "▶ " : waits ? "… " : all("squashed") ? "✕ " : all("retired") ? "✓ " : "";
      const times = node.members.length > 1 ? ` ×${count(node.members.length)}` : "";
      context.fillStyle = colour("ink");
      context.fillText(fitted(context, `${pauses}${mark}${node.label}${times}`, WIDE - 14), node.x + 7, node.y + TALL / 2 + 1);
    }
    context.globalAlpha = 1;
  }

  at(x: number, y: number): { id: number; text: string } | null {
    const [inX, inY] = [(x - this.left) / this.scale, (y - this.top) / this.scale];
    const node = this.nodes.findLast((one) => inX >= one.x && inX <= one.x + WIDE && inY >= one.y && inY <= one.y + TALL);
    const one = node?.members.at(-1);
    if (node === undefined || one === undefined) return null;
    const many = node.members.length > 1 ? `${node.row}: ${count(node.members.length)} instances; the last of them:\n` : "";
    return { id: one.id, text: `${many}${hint(this.store, one, one.jobs.at(-1) ?? null)}` };
  }

  pan(dx: number, dy: number): void {
    this.fits = false;
    this.left += dx;
    this.top += dy;
  }

  zoom(factor: number, x: number, y: number): void {
    this.fits = false;
    const scale = Math.max(0.01, Math.min(this.scale * factor, 4));
    this.left = x - ((x - this.left) * scale) / this.scale;
    this.top = y - ((y - this.top) * scale) / this.scale;
    this.scale = scale;
  }

  fit(): void {
    this.fits = true;
    let [right, bottom] = [1, 1];
    for (const node of this.nodes) [right, bottom] = [Math.max(right, node.x + WIDE + MARGIN), Math.max(bottom, node.y + TALL + MARGIN)];
    const whole = Math.min(this.size.width / right, this.size.height / bottom);
    // Names shall be read: of what is large the end is shown, where things happen.
    const readable = Math.min(0.8, Math.max(this.size.height / bottom, 0.15));
    this.scale = whole >= 0.45 ? Math.min(whole, 1.2) : Math.max(whole, readable);
    this.left = Math.min(0, this.size.width - right * this.scale);
    this.top = 0;
    const open = this.nodes.find((node) => node.members.some((one) => one.stage === "running" || one.stage === "asking"));
    if (open !== undefined && bottom * this.scale > this.size.height) {
      this.top = Math.min(0, Math.max(this.size.height - bottom * this.scale, this.size.height / 2 - open.y * this.scale));
    }
  }

  /** Brings an instance into the middle. */
  show(id: number): void {
    this.wanted = id;
  }

  private centre(id: number): void {
    const node = this.byInstance.get(id);
    if (node === undefined) return;
    this.fits = false;
    this.scale = Math.max(this.scale, 0.7);
    this.left = this.size.width / 2 - (node.x + WIDE / 2) * this.scale;
    this.top = this.size.height / 2 - (node.y + TALL / 2) * this.scale;
  }

  step(direction: "left" | "right" | "up" | "down"): number | null {
    const chosen = this.store.selected === null ? undefined : this.byInstance.get(this.store.selected);
    if (chosen === undefined) return this.nodes[0]?.members.at(-1)?.id ?? null;
    const sideways = direction === "left" || direction === "right";
    const sign = direction === "left" || direction === "up" ? -1 : 1;
    let best: Node | undefined;
    let least = Infinity;
    for (const node of this.nodes) {
      const [dx, dy] = [node.x - chosen.x, node.y - chosen.y];
      const along = (sideways ? dx : dy) * sign;
      const distance = along + Math.abs(sideways ? dy : dx) * 3;
      if (along > 0 && distance < least) [best, least] = [node, distance];
    }
    const id = best?.members.at(-1)?.id ?? null;
    if (id !== null) this.show(id);
    return id;
  }
}

/** The states around one, the outermost first. */
function outer(state: string): string[] {
  const parts = state.split("/");
  return parts.slice(1).map((_, index) => parts.slice(0, index + 1).join("/"));
}

function compare(a: number[], b: number[]): number {
  for (let index = 0; index < Math.min(a.length, b.length); index += 1) {
    const by = (a[index] ?? 0) - (b[index] ?? 0);
    if (by !== 0) return by;
  }
  return a.length - b.length;
}
