// The Gantt chart: a row for each resource, state or host, a bar for each job.

import { seconds } from "./dom";
import { hint, lastName } from "./say";
import type { Store } from "./store";
import { colour } from "./theme";
import { type Painter, fitted, niceStep } from "./view";
import type { Instance, Job } from "./wire";

export type By = "resource" | "node" | "host";

interface Bar {
  from: number;
  /** Infinite while it goes on. */
  to: number;
  lane: number;
  one: Instance;
  /** None for a wait. */
  job: Job | null;
}

interface Row {
  name: string;
  bars: Bar[];
  lanes: number;
  /** The lane of the chart at which it begins. */
  top: number;
}

const LANE = 20;
const AXIS = 22;
const NONE = "no resource";

export class Gantt implements Painter {
  private rows: Row[] = [];
  private lanes = 0;
  private laidOut = -1;
  private laidOutBy: By = "resource";
  private from = 0;
  private to = 1;
  private scroll = 0;
  private size = { width: 1, height: 1, label: 150 };
  /** The user has not chosen a part of the time: all of it is shown as it grows. */
  follows = true;
  /** Another chart that shows the same time. */
  beside: Gantt | null = null;

  constructor(
    private readonly store: Store,
    public by: By,
  ) {}

  private layOut(): void {
    if (this.laidOut === this.store.generation && this.laidOutBy === this.by) return;
    [this.laidOut, this.laidOutBy] = [this.store.generation, this.by];
    const rows = new Map<string, Bar[]>();
    const add = (name: string, bar: Bar) => {
      const bars = rows.get(name);
      if (bars === undefined) rows.set(name, [bar]);
      else bars.push(bar);
    };
    for (const one of this.store.instances.values()) {
      for (const job of one.jobs) {
        const bar = { from: job.from_s, to: job.to_s ?? Infinity, lane: 0, one, job };
        for (const name of this.names(one, job)) add(name, { ...bar });
      }
      if (this.by === "node") {
        for (const wait of one.waits) {
          if (wait.to_s > wait.from_s) add(one.state, { from: wait.from_s, to: wait.to_s, lane: 0, one, job: null });
        }
        if (one.stage === "asking") add(one.state, { from: one.since_s, to: Infinity, lane: 0, one, job: null });
      }
    }
    this.lanes = 0;
    // States stand in the order of the program, resources and hosts by name.
    const first = (bars: Bar[]) => bars.reduce((least, bar) => Math.min(least, bar.one.id), Infinity);
    const named = [...rows].sort(([a, ofA], [b, ofB]) => {
      if (this.by === "node") return first(ofA) - first(ofB);
      return a === NONE ? 1 : b === NONE ? -1 : a.localeCompare(b, "en", { numeric: true });
    });
    this.rows = named.map(([name, bars]) => {
      bars.sort((a, b) => a.from - b.from);
      const ends: number[] = [];
      for (const bar of bars) {
        let lane = ends.findIndex((end) => end <= bar.from + 1e-9);
        if (lane < 0) lane = ends.length;
        ends[lane] = bar.to;
        bar.lane = lane;
      }
      const row = { name, bars, lanes: ends.length, top: this.lanes };
      this.lanes += ends.length;
      return row;
    });
  }

  private names(one: Instance, job: Job): string[] {
    switch (this.by) {
      case "node":
        return [one.state];
      case "resource":
        return job.resources.length === 0 ? [NONE] : job.resources;
      case "host": {
        const hosts = new Set(job.resources.map((id) => (id.includes("@") ? id.slice(id.lastIndexOf("@") + 1) : NONE)));
        return hosts.size === 0 ? [NONE] : [...hosts];
      }
    }
  }

  private x(moment: number): number {
    const { width, label } = this.size;
    return label + ((moment - this.from) / (this.to - this.from)) * (width - label);
  }

  private moment(x: number): number {
    const { width, label } = this.size;
    return this.from + ((x - label) / (width - label)) * (this.to - this.from);
  }

  paint(context: CanvasRenderingContext2D, width: number, height: number): void {
    this.layOut();
    this.size = { width, height, label: width < 600 ? 90 : 170 };
    if (this.follows) this.fit();
    this.scroll = Math.max(0, Math.min(this.scroll, this.lanes * LANE + AXIS - height));
    const { label } = this.size;
    context.font = "12px system-ui, sans-serif";
    context.textBaseline = "middle";
    this.paintAxis(context);
    context.save();
    context.beginPath();
    context.rect(0, AXIS, width, height - AXIS);
    context.clip();
    for (const row of this.rows) {
      const top = AXIS + row.top * LANE - this.scroll;
      const tall = row.lanes * LANE;
      if (top + tall < AXIS || top > height) continue;
      context.fillStyle = colour("line");
      context.fillRect(0, top + tall - 0.5, width, 0.5);
      context.fillStyle = colour("ink");
      context.fillText(this.label(context, row.name), 6, top + LANE / 2 + 1);
    }
    context.beginPath();
    context.rect(label, AXIS, width - label, height - AXIS);
    context.clip();
    for (const span of this.store.run?.pauses ?? []) this.paintSpan(context, span.from_s, span.to_s, "warn");
    for (const span of this.store.run?.absences ?? []) this.paintSpan(context, span.from_s, span.to_s, "bad");
    for (const row of this.rows) this.paintRow(context, row);
    const now = this.x(this.store.at);
    context.fillStyle = colour("bad");
    context.fillRect(now, AXIS, 1, height);
    context.restore();
  }

  /** Where there is little room, a resource without its host. */
  private label(context: CanvasRenderingContext2D, name: string): string {
    const room = this.size.label - 12;
    const short = this.by === "resource" && context.measureText(name).width > room ? name.replace(/@[^@]*$/, "") : name;
    return fitted(context, short, room, true);
  }

  private paintAxis(context: CanvasRenderingContext2D): void {
    const { width, height, label } = this.size;
    const step = niceStep(this.to - this.from, (width - label) / 90);
    context.textAlign = "center";
    for (let tick = Math.ceil(this.from / step) * step; tick <= this.to; tick += step) {
      const x = this.x(tick);
      context.fillStyle = colour("idle");
      context.fillRect(x, AXIS, 1, height);
      context.fillStyle = colour("faint");
      context.fillText(seconds(tick, step < 0.1 ? 2 : step < 1 ? 1 : 0), Math.max(x, label + 14), AXIS / 2);
    }
    context.textAlign = "left";
  }

  private paintSpan(context: CanvasRenderingContext2D, from: number, to: number, name: string): void {
    context.globalAlpha = 0.13;
    context.fillStyle = colour(name);
    context.fillRect(this.x(from), AXIS, Math.max(this.x(to) - this.x(from), 1), this.size.height);
    context.globalAlpha = 1;
  }

  private paintRow(context: CanvasRenderingContext2D, row: Row): void {
    const { width, height, label } = this.size;
    const top = AXIS + row.top * LANE - this.scroll;
    if (top + row.lanes * LANE < AXIS || top > height) return;
    const drawn = new Float64Array(row.lanes).fill(-1);
    for (const bar of row.bars) {
      const to = Math.min(bar.to, this.store.at);
      if (to < this.from) continue;
      if (bar.from > this.to) break;
      const left = Math.max(this.x(bar.from), label - 4);
      const right = Math.min(this.x(to), width + 4);
      const y = top + bar.lane * LANE;
      // Bars that fall on pixels that are painted already are not painted again.
      if (right <= (drawn[bar.lane] ?? -1) + 0.5) continue;
      drawn[bar.lane] = right;
      this.paintBar(context, bar, left, y, Math.max(right - left, 1));
    }
  }

  private paintBar(context: CanvasRenderingContext2D, bar: Bar, left: number, y: number, wide: number): void {
    const { job, one } = bar;
    if (job === null) {
      context.fillStyle = colour("warn");
      context.fillRect(left, y + LANE / 2 - 1.5, wide, 3);
      return;
    }
    const lost = job.worth === "lost" || one.stage === "squashed";
    const failed = job.ending === "crashed" || job.ending === "aborted";
    context.globalAlpha = lost ? 0.4 : 1;
    context.fillStyle = colour(job.activity);
    context.fillRect(left, y + 2, wide, LANE - 4);
    context.globalAlpha = 1;
    if (wide < 3) return;
    context.setLineDash(lost || (one.speculative && one.stage !== "retired") ? [4, 3] : []);
    context.lineWidth = failed ? 2 : 1;
    context.strokeStyle = colour(failed ? "bad" : "faint");
    context.strokeRect(left + 0.5, y + 2.5, wide - 1, LANE - 5);
    context.setLineDash([]);
    if (one.id === this.store.selected) {
      context.lineWidth = 3;
      context.strokeStyle = colour("accent");
      context.strokeRect(left, y + 1.5, wide, LANE - 3);
    }
    context.lineWidth = 1;
    if (wide > 34) {
      context.fillStyle = colour("ink");
      const name = this.by === "node" ? (one.path.match(/\[\d+\]/g)?.join("") ?? lastName(one.path)) : lastName(one.path);
      context.fillText(fitted(context, name, wide - 8), left + 4, y + LANE / 2 + 1);
    }
  }

  at(x: number, y: number): { id: number; text: string } | null {
    if (x < this.size.label || y < AXIS) return null;
    const lane = Math.floor((y - AXIS + this.scroll) / LANE);
    const row = this.rows.find((one) => lane >= one.top && lane < one.top + one.lanes);
    if (row === undefined) return null;
    const [before, after] = [this.moment(x - 2), this.moment(x + 2)];
    const now = this.store.at;
    const found = row.bars.findLast(
      (bar) => bar.lane === lane - row.top && bar.from <= after && Math.min(bar.to, now) >= before,
    );
    return found === undefined ? null : { id: found.one.id, text: hint(this.store, found.one, found.job) };
  }

  pan(dx: number, dy: number): void {
    this.scroll -= dy;
    if (dx === 0) return;
    this.follows = false;
    const by = (-dx / (this.size.width - this.size.label)) * (this.to - this.from);
    this.show(this.from + by, this.to + by);
  }

  zoom(factor: number, x: number): void {
    this.follows = false;
    const middle = this.moment(Math.max(x, this.size.label));
    this.show(middle - (middle - this.from) / factor, middle + (this.to - middle) / factor);
  }

  fit(): void {
    this.follows = true;
    const from = this.store.run?.from_s ?? 0;
    const until = Math.max(this.store.at, this.beside?.store.at ?? 0);
    [this.from, this.to] = [from, from + Math.max((until - from) * 1.02, 1)];
    if (this.beside !== null) this.beside.follows = true;
  }

  private show(from: number, to: number): void {
    const last = Math.max(this.store.run?.last_s ?? 0, this.store.at, this.beside?.store.at ?? 0, 1);
    const length = Math.max(Math.min(to - from, last * 4), 1e-3);
    const begin = Math.max(-length / 2, Math.min(from, last));
    [this.from, this.to] = [begin, begin + length];
    if (this.beside !== null) [this.beside.from, this.beside.to, this.beside.follows] = [this.from, this.to, false];
  }

  step(direction: "left" | "right" | "up" | "down"): number | null {
    const chosen = this.store.selected;
    const at = this.rows.findIndex((row) => row.bars.some((bar) => bar.one.id === chosen && bar.job !== null));
    const row = this.rows[at];
    if (row === undefined) return this.rows[0]?.bars[0]?.one.id ?? null;
    const index = row.bars.findIndex((bar) => bar.one.id === chosen);
    const bar = row.bars[index];
    if (bar === undefined) return null;
    if (direction === "left" || direction === "right") {
      return row.bars[index + (direction === "left" ? -1 : 1)]?.one.id ?? null;
    }
    const other = this.rows[at + (direction === "up" ? -1 : 1)];
    if (other === undefined) return null;
    this.scroll = Math.max(0, Math.min(this.scroll, other.top * LANE));
    const bottom = (other.top + other.lanes) * LANE + AXIS - this.size.height;
    this.scroll = Math.max(this.scroll, bottom);
    return (other.bars.find((one) => one.to >= bar.from) ?? other.bars.at(-1))?.one.id ?? null;
  }
}
