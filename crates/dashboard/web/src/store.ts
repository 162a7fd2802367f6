// What is known of the run that is looked at: frames put together.

import type { Edge, Frame, Instance, Run, Task } from "./wire";

export class Store {
  readonly instances = new Map<number, Instance>();
  frame: Frame | null = null;
  /** Counts what changed of the instances, so that a view knows whether to lay out again. */
  generation = 0;
  selected: number | null = null;
  /** The task as its author wrote it, where that is known. */
  task: Task | null = null;
  /** Of each state what its inputs and its existence depend on, as written. */
  private flows = new Map<string, { from: string; kind: string }[]>();
  private byState = new Map<string, Instance[]>();
  private grouped = -1;

  get run(): Run | null {
    return this.frame?.run ?? null;
  }

  get at(): number {
    return this.frame?.run.at_s ?? 0;
  }

  clear(): void {
    this.instances.clear();
    this.frame = null;
    this.selected = null;
    this.setTask(null);
  }

  setTask(task: Task | null): void {
    this.task = task;
    this.flows = new Map();
    for (const { from, to, kind } of task?.flows ?? []) {
      const flows = this.flows.get(to);
      if (flows === undefined) this.flows.set(to, [{ from, kind }]);
      else flows.push({ from, kind });
    }
    this.generation += 1;
  }

  /** On whom an instance depends: as the log tells, and as the task says. */
  edges(one: Instance): Edge[] {
    const flows = this.flows.get(one.state);
    if (flows === undefined) return one.edges;
    this.group();
    const known = new Set(one.edges.map((edge) => `${edge.from} ${edge.kind}`));
    const more: Edge[] = [];
    for (const { from, kind } of flows) {
      const source = this.source(one, from);
      if (source !== null && !known.has(`${source} ${kind}`)) more.push({ from: source, kind });
    }
    return more.length === 0 ? one.edges : [...one.edges, ...more];
  }

  /** The visit of a state whose result an instance gets: the youngest before it, of the same visits of what is around both if there is one. */
  private source(one: Instance, state: string): number | null {
    const all = this.byState.get(state);
    if (all === undefined) return null;
    const around = commonVisits(one, state);
    let youngest: number | null = null;
    for (let index = before(all, one.id) - 1; index >= 0; index -= 1) {
      const other = all[index];
      if (other === undefined) break;
      youngest ??= other.id;
      if (other.path.startsWith(around)) return other.id;
      // So far back nobody of the same visits stands.
      if (before(all, one.id) - index > 64) break;
    }
    return youngest;
  }

  private group(): void {
    if (this.grouped === this.generation) return;
    this.grouped = this.generation;
    this.byState = new Map();
    for (const one of this.instances.values()) {
      const all = this.byState.get(one.state);
      if (all === undefined) this.byState.set(one.state, [one]);
      else all.push(one);
    }
    for (const all of this.byState.values()) all.sort((a, b) => a.id - b.id);
  }

  apply(frame: Frame): void {
    if (frame.fresh || (this.frame !== null && this.frame.epoch !== frame.epoch)) this.instances.clear();
    for (const id of frame.gone) this.instances.delete(id);
    for (const one of frame.instances) this.instances.set(one.id, one);
    if (frame.fresh || frame.instances.length > 0 || frame.gone.length > 0) this.generation += 1;
    this.frame = frame;
  }

  /** Why an instance waits, where that is known. */
  why(id: number): string | null {
    return this.frame?.waiting.find((one) => one.id === id)?.sentence ?? null;
  }
}

/** How many of them are older. */
function before(all: Instance[], id: number): number {
  let [low, high] = [0, all.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((all[middle]?.id ?? Infinity) < id) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The parts of a path; a `/` inside brackets is a key's. */
export function splitPath(path: string): string[] {
  const parts: string[] = [];
  let [depth, part] = [0, ""];
  for (const letter of path) {
    if (letter === "[") depth += 1;
    if (letter === "]") depth = Math.max(0, depth - 1);
    if (letter === "/" && depth === 0) {
      parts.push(part);
      part = "";
    } else part += letter;
  }
  return [...parts, part];
}

/** The part of an instance's path that a visit of another state has, too, if it stands in the same visits. */
function commonVisits(one: Instance, state: string): string {
  const [own, other, visits] = [one.state.split("/"), state.split("/"), splitPath(one.path)];
  let common = 0;
  while (common < own.length - 1 && common < other.length - 1 && own[common] === other[common]) common += 1;
  return common === 0 ? "" : `${visits.slice(0, common).join("/")}/`;
}
