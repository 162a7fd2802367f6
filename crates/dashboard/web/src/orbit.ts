// An eye that goes around a point, by mouse, fingers and keys.

import { type Matrix, type Vector, compose, cross, looking, minus, perspective, plus, unit } from "./matrix";

const ANGLE = 0.8;

/** From how far away a sphere of this radius is in view as a whole. */
export const whole = (radius: number): number => radius / Math.sin(ANGLE / 2);
const LINE_PX = 16;
const NEAREST_M = 0.15;
const FARTHEST_M = 60;

/** What is in view at first: robot and table, from the side. */
const FIRST = { at: [0.1, 0, 0.6] as Vector, heading: -0.9, height: 0.45, distance: 4.2 };

export class Orbit {
  private at: Vector = FIRST.at;
  private heading = FIRST.heading;
  private height = FIRST.height;
  distance = FIRST.distance;
  private readonly touches = new Map<number, { x: number; y: number }>();

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly repaint: () => void,
    private first: () => { at: Vector; distance: number } | null,
  ) {
    this.listen();
  }

  /** From what is seen to the eye. */
  get back(): Vector {
    const flat = Math.cos(this.height);
    return [flat * Math.cos(this.heading), flat * Math.sin(this.heading), Math.sin(this.height)];
  }

  view(aspect: number): Matrix {
    const eye = plus(this.at, this.back, this.distance);
    return compose(perspective(ANGLE, aspect, this.distance / 50, this.distance * 50), looking(eye, this.at));
  }

  fit(): void {
    const found = this.first();
    [this.at, this.heading, this.height] = [found?.at ?? FIRST.at, FIRST.heading, FIRST.height];
    this.distance = found?.distance ?? FIRST.distance;
    this.repaint();
  }

  turn(dx: number, dy: number): void {
    this.heading -= dx * 0.008;
    this.height = Math.min(Math.max(this.height + dy * 0.008, -1.5), 1.5);
    this.repaint();
  }

  zoom(factor: number): void {
    this.distance = Math.min(Math.max(this.distance / factor, NEAREST_M), FARTHEST_M);
    this.repaint();
  }

  pan(dx: number, dy: number): void {
    const metres = (2 * this.distance * Math.tan(ANGLE / 2)) / Math.max(this.canvas.clientHeight, 1);
    const right = unit(cross([0, 0, 1], this.back));
    const up = cross(this.back, right);
    const moved = plus(plus(this.at, right, -dx * metres), up, dy * metres);
    // Nobody finds back from farther away.
    if (Math.hypot(...minus(moved, FIRST.at)) < FARTHEST_M) this.at = moved;
    this.repaint();
  }

  private listen(): void {
    const canvas = this.canvas;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.touches.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = this.touches.get(event.pointerId);
      if (before === undefined) return;
      const at = { x: event.clientX, y: event.clientY };
      const other = [...this.touches].find(([id]) => id !== event.pointerId)?.[1];
      const [dx, dy] = [at.x - before.x, at.y - before.y];
      if (other !== undefined) {
        // Two fingers move it together and zoom by their distance.
        const length = (a: { x: number; y: number }) => Math.max(Math.hypot(a.x - other.x, a.y - other.y), 1);
        this.zoom(length(at) / length(before));
        this.pan(dx / 2, dy / 2);
      } else if (event.shiftKey || (event.buttons & 6) !== 0) this.pan(dx, dy);
      else this.turn(dx, dy);
      this.touches.set(event.pointerId, at);
    });
    const up = (event: PointerEvent) => void this.touches.delete(event.pointerId);
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        const lines = event.deltaMode === 1 ? LINE_PX : 1;
        if (event.shiftKey) this.pan(-(event.deltaX || event.deltaY) * lines, 0);
        else this.zoom(Math.exp(-event.deltaY * lines * (event.ctrlKey ? 0.006 : 0.0012)));
      },
      { passive: false },
    );
    canvas.addEventListener("keydown", (event) => {
      if (event.altKey || event.metaKey || event.ctrlKey) return;
      const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] } as const;
      const key = event.key;
      if (key in arrows) {
        const [dx, dy] = arrows[key as keyof typeof arrows];
        if (event.shiftKey) this.pan(dx * 40, dy * 40);
        else this.turn(-dx * 16, -dy * 16);
      } else if (key === "+" || key === "=") this.zoom(1.25);
      else if (key === "-") this.zoom(1 / 1.25);
      else if (key === "0") this.fit();
      else return;
      event.preventDefault();
    });
  }
}
