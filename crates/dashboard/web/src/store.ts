// What is known of the run that is looked at: frames put together.

import type { Frame, Instance, Run } from "./wire";

export class Store {
  readonly instances = new Map<number, Instance>();
  frame: Frame | null = null;
  /** Counts what changed of the instances, so that a view knows whether to lay out again. */
  generation = 0;
  selected: number | null = null;

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
    this.generation += 1;
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
