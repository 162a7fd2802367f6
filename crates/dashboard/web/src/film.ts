// Where joints are at a moment: tracks put together, and what is between two points of one.

import type { Cell, Point, Robot, Track } from "./wire";

/** Joints begin a track that does not say where it begins from where they were; so many such tracks are followed. */
const MOST_BEFORE = 8;

export class Film {
  private tracks: Track[] = [];
  epoch = 0;
  version = 0;

  take(cell: Cell): void {
    const known = new Map(cell.fresh || cell.epoch !== this.epoch ? [] : this.tracks.map((track) => [track.id, track]));
    for (const track of cell.tracks) known.set(track.id, track);
    this.tracks = cell.kept.flatMap((id) => known.get(id) ?? []);
    [this.epoch, this.version] = [cell.epoch, cell.version];
  }

  clear(): void {
    this.tracks = [];
    [this.epoch, this.version] = [0, 0];
  }

  /** A position for each joint at a moment. */
  at(robot: Robot, moment: number): number[] {
    return robot.joints.map((joint, index) => this.joint(index, moment, this.tracks.length, 0) ?? joint.start);
  }

  /** Whether the log has said where a joint is by a moment. */
  knows(joint: number, moment: number): boolean {
    return this.tracks.some((track) => track.from_s <= moment && track.joints.includes(joint));
  }

  /** What moves something at a moment. */
  moving(moment: number): Track[] {
    const moves = (track: Track) => track.from_s <= moment && moment < (track.until_s ?? track.from_s + lasts(track));
    return this.tracks.filter(moves);
  }

  /** The last of the first tracks that has begun and says something of a joint, else none. */
  private joint(joint: number, moment: number, before: number, depth: number): number | null {
    for (let index = before - 1; index >= 0; index -= 1) {
      const track = this.tracks[index];
      if (track === undefined || track.from_s > moment) continue;
      const column = track.joints.indexOf(joint);
      if (column < 0) continue;
      const after = Math.min(moment, track.until_s ?? Infinity) - track.from_s;
      const begin = () => (depth < MOST_BEFORE ? this.joint(joint, track.from_s, index, depth + 1) : null);
      return between(track.points, column, after, begin);
    }
    return null;
  }
}

export function lasts(track: Track): number {
  return track.points.at(-1)?.after_s ?? 0;
}

/** A position of a track so many seconds after it began. `begin` says where that was, if its points do not. */
export function between(points: readonly Point[], column: number, after: number, begin: () => number | null = () => null): number | null {
  const next = following(points, after);
  const [a, b] = [points[next - 1], points[next]];
  const [from, to] = [a?.positions[column] ?? (next === 0 ? begin() : null), b?.positions[column]];
  if (to === undefined) return from;
  if (from === null || b === undefined) return to;
  const since = a?.after_s ?? 0;
  const long = b.after_s - since;
  if (!(long > 0)) return to;
  const share = Math.min(Math.max((after - since) / long, 0), 1);
  // A track that only says its end begins at rest.
  const [u, v] = [a === undefined ? 0 : a.velocities[column], b.velocities[column]];
  if (u === undefined || v === undefined) return from + share * (to - from);
  // The cubic that has both positions and both speeds (Hermite).
  const [s, t] = [share, 1 - share];
  return t * t * ((1 + 2 * s) * from + s * long * u) + s * s * ((1 + 2 * t) * to - t * long * v);
}

/** How many points are not later. */
function following(points: readonly Point[], after: number): number {
  let [low, high] = [0, points.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((points[middle]?.after_s ?? Infinity) <= after) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** What is shown follows what was told, from one answer to the next: nothing jumps, whatever the speed of a replay or of the robot. */
export class Clock {
  private from = 0;
  private to = 0;
  private began = 0;
  private takes = 0;

  /** A moment was told. A jump of the reader, back or far ahead, is made at once. */
  tell(moment: number, now: number, glides: boolean): void {
    const shown = this.at(now);
    const since = now - this.began;
    if (!glides || moment < shown || since > MOST_GLIDE_MS) [this.from, this.takes] = [moment, 0];
    else [this.from, this.takes] = [shown, Math.max(since, 1)];
    [this.to, this.began] = [moment, now];
  }

  at(now: number): number {
    if (this.takes === 0) return this.to;
    return this.from + (this.to - this.from) * Math.min((now - this.began) / this.takes, 1);
  }

  /** It has not come to what was told. */
  runs(now: number): boolean {
    return now - this.began < this.takes;
  }
}

/** After a longer silence what is told is shown at once. */
const MOST_GLIDE_MS = 1500;
