// A canvas that can be dragged, zoomed and used by keys. What is on it is drawn by whoever owns it.

import { h } from "./dom";

export interface Painter {
  /** Draws everything that is in view. */
  paint(context: CanvasRenderingContext2D, width: number, height: number): void;
  /** The instance at a place, and what a hint says of it. */
  at(x: number, y: number): { id: number; text: string } | null;
  /** The view moves by so many pixels. */
  pan(dx: number, dy: number): void;
  /** The view is scaled around a place. */
  zoom(factor: number, x: number, y: number): void;
  fit(): void;
  /** The next instance in a direction from the one that is chosen. */
  step(direction: "left" | "right" | "up" | "down"): number | null;
}

const LABEL_TIME = 16;

export class View {
  readonly element: HTMLElement;
  readonly canvas: HTMLCanvasElement;
  /** How long the last painting took, in milliseconds. */
  paintedIn = 0;
  private readonly tip = h("div", { class: "tip", hidden: true, role: "presentation" });
  private dirty = false;
  private drag: { x: number; y: number; moved: boolean } | null = null;
  private readonly touches = new Map<number, { x: number; y: number }>();

  constructor(
    label: string,
    private readonly painter: Painter,
    private readonly choose: (id: number) => void,
    private readonly open: (id: number) => void,
  ) {
    this.canvas = h("canvas", { tabindex: 0, role: "application", "aria-label": label });
    this.element = h("div", { class: "canvas" }, this.canvas, this.tip);
    new ResizeObserver(() => this.repaint()).observe(this.element);
    this.listen();
  }

  repaint(): void {
    if (this.dirty) return;
    this.dirty = true;
    const paint = () => {
      if (!this.dirty) return;
      this.dirty = false;
      this.paint();
    };
    requestAnimationFrame(paint);
  }

  private paint(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (width === 0 || height === 0) return;
    const ratio = window.devicePixelRatio;
    const [w, t] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.canvas.width !== w || this.canvas.height !== t) [this.canvas.width, this.canvas.height] = [w, t];
    const context = this.canvas.getContext("2d");
    if (context === null) return;
    const began = performance.now();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    this.painter.paint(context, width, height);
    this.paintedIn = performance.now() - began;
    this.canvas.dataset["paintedMs"] = this.paintedIn.toFixed(1);
  }

  private place(event: MouseEvent): { x: number; y: number } {
    const box = this.canvas.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  }

  private listen(): void {
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const at = this.place(event);
      this.touches.set(event.pointerId, at);
      this.drag = { ...at, moved: false };
    });
    canvas.addEventListener("pointermove", (event) => {
      const at = this.place(event);
      const before = this.touches.get(event.pointerId);
      if (before === undefined || this.drag === null) {
        this.hint(at.x, at.y);
        return;
      }
      const other = [...this.touches].find(([id]) => id !== event.pointerId)?.[1];
      if (other !== undefined) {
        // Two fingers: what is between them grows with their distance.
        const length = (a: { x: number; y: number }) => Math.hypot(a.x - other.x, a.y - other.y);
        this.painter.zoom(Math.max(length(at), 1) / Math.max(length(before), 1), (at.x + other.x) / 2, (at.y + other.y) / 2);
        this.drag.moved = true;
      } else if (this.drag.moved || Math.hypot(at.x - this.drag.x, at.y - this.drag.y) > 4) {
        this.drag.moved = true;
        this.painter.pan(at.x - before.x, at.y - before.y);
      }
      this.touches.set(event.pointerId, at);
      this.tip.hidden = true;
      this.repaint();
    });
    const up = (event: PointerEvent) => {
      this.touches.delete(event.pointerId);
      const drag = this.drag;
      if (this.touches.size === 0) this.drag = null;
      if (event.type !== "pointerup" || drag === null || drag.moved) return;
      const { x, y } = this.place(event);
      const found = this.painter.at(x, y);
      if (found !== null) this.choose(found.id);
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("pointerleave", () => {
      this.tip.hidden = true;
    });
    canvas.addEventListener("dblclick", (event) => {
      const { x, y } = this.place(event);
      const found = this.painter.at(x, y);
      if (found !== null) this.open(found.id);
    });
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        const { x, y } = this.place(event);
        const lines = event.deltaMode === 1 ? LABEL_TIME : 1;
        if (event.ctrlKey || event.metaKey) this.painter.zoom(Math.exp(-event.deltaY * lines * 0.004), x, y);
        else if (event.shiftKey) this.painter.pan(-event.deltaY * lines, 0);
        else this.painter.pan(-event.deltaX * lines, -event.deltaY * lines);
        this.repaint();
      },
      { passive: false },
    );
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  private key(event: KeyboardEvent): void {
    const middle = [this.element.clientWidth / 2, this.element.clientHeight / 2] as const;
    const steps = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down" } as const;
    const moves = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] } as const;
    if (event.altKey || event.metaKey) return;
    const key = event.key;
    if (key in steps && event.shiftKey) {
      const [dx, dy] = moves[key as keyof typeof moves];
      this.painter.pan(dx, dy);
    } else if (key in steps) {
      const next = this.painter.step(steps[key as keyof typeof steps]);
      if (next !== null) this.choose(next);
    } else if (key === "+" || key === "=") this.painter.zoom(1.3, middle[0], middle[1]);
    else if (key === "-") this.painter.zoom(1 / 1.3, middle[0], middle[1]);
    else if (key === "0") this.painter.fit();
    else if (key === "Enter") {
      this.open(-1);
    } else return;
    event.preventDefault();
    this.repaint();
  }

  private hint(x: number, y: number): void {
    const found = this.painter.at(x, y);
    this.canvas.style.cursor = found === null ? "grab" : "pointer";
    this.tip.hidden = found === null;
    if (found === null) return;
    this.tip.textContent = found.text;
    const { clientWidth: width, clientHeight: height } = this.element;
    this.tip.style.left = `${Math.max(0, Math.min(x + 14, width - this.tip.offsetWidth - 6))}px`;
    this.tip.style.top = `${Math.max(0, Math.min(y + 14, height - this.tip.offsetHeight - 6))}px`;
  }
}

/** `text`, shortened so that it is no wider than so many pixels. */
export function fitted(context: CanvasRenderingContext2D, text: string, width: number, keepEnd = false): string {
  const wide = context.measureText("m").width * 0.72;
  const room = Math.floor(width / wide);
  if (text.length <= room || context.measureText(text).width <= width) return text;
  if (room < 2) return "";
  return keepEnd ? `…${text.slice(text.length - room + 1)}` : `${text.slice(0, room - 1)}…`;
}

/** A step of 1, 2 or 5 times a power of ten, of which about so many fit. */
export function niceStep(span: number, about: number): number {
  const raw = span / Math.max(about, 1);
  const power = 10 ** Math.floor(Math.log10(raw));
  const factor = raw / power;
  return power * (factor <= 1 ? 1 : factor <= 2 ? 2 : factor <= 5 ? 5 : 10);
}
