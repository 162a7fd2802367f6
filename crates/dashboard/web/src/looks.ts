// What of a robot is drawn: what is seen of it, in its colours, or what of it can collide.

import { type Matrix, compose, identity, placed } from "./matrix";
import type { Colour, Solid } from "./webgl";
import type { Robot } from "./wire";

export class Looks {
  /** Draw what can collide, although the robot has visuals. */
  collides = false;
  /** Why meshes are missing. */
  problem = "";
  private robot: Robot | null = null;
  private readonly meshes = new Map<number, ArrayBuffer>();

  /** `arrived` is called when a mesh is there. */
  constructor(
    private readonly ask: (mesh: number) => Promise<ArrayBuffer>,
    private readonly arrived: () => void,
  ) {}

  /** Takes a robot, and gets its meshes one after the other: what else the page asks for does not wait behind them. */
  async take(robot: Robot): Promise<void> {
    this.robot = robot;
    this.problem = "";
    this.meshes.clear();
    const numbers = new Set(robot.links.flatMap((link) => link.visuals.flatMap(({ mesh }) => mesh ?? [])));
    for (const number of numbers) {
      try {
        const corners = await this.ask(number);
        if (this.robot !== robot) return;
        this.meshes.set(number, corners);
      } catch (error) {
        if (this.robot === robot) this.problem = `A mesh is not there: ${error instanceof Error ? error.message : String(error)}`;
        return;
      }
      this.arrived();
    }
  }

  /** Whether the robot's description says what is seen. */
  areKnown(robot: Robot): boolean {
    return robot.links.some((link) => link.visuals.length > 0);
  }

  /** The meshes that are there. */
  get loaded(): ReadonlySet<ArrayBuffer> {
    return new Set(this.meshes.values());
  }

  /** What is drawn of a robot whose links have these frames. Without a colour of its own a shape has `plain`. */
  solids(robot: Robot, frames: readonly Matrix[], plain: Colour): Solid[] {
    const seen = this.areKnown(robot) && !this.collides;
    return robot.links.flatMap((link, index) => {
      const frame = frames[index] ?? identity();
      if (!seen) return link.shapes.map(({ kind, size, at }): Solid => ({ kind, size, frame: compose(frame, placed(at)), colour: plain }));
      return link.visuals.flatMap(({ shape: { kind, size, at }, mesh, colour }): Solid[] => {
        const corners = mesh === null ? undefined : this.meshes.get(mesh);
        // A mesh that is on its way is not drawn yet.
        if (mesh !== null && corners === undefined) return [];
        const own: Colour = colour === null ? plain : [colour[0] ?? 0, colour[1] ?? 0, colour[2] ?? 0];
        return [{ kind, size, frame: compose(frame, placed(at)), colour: own, ...(corners === undefined ? {} : { corners }) }];
      });
    });
  }
}
