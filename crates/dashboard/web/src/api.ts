// What the pages ask the program that served them.

import type { Proposal } from "./annotations";
import type { About, Annotations, Cell, Frame, Gained, Proposed, Robot, System, Tail, Task, Told, World } from "./wire";

const TOKEN = "ratn-token";

/** Takes the token out of the address, where it would stay in the history. */
export function takeToken(): void {
  const found = /^#token=([0-9a-f]+)$/.exec(location.hash);
  if (found?.[1] !== undefined) {
    sessionStorage.setItem(TOKEN, found[1]);
    history.replaceState(null, "", "#/run");
  }
}

/** An answer that says no. */
export class Refused extends Error {
  constructor(
    readonly status: number,
    message: string,
  ) {
    super(message);
  }
}

type Query = Record<string, string | number | null>;

async function fetched(path: string, query: Query, method: string, body: unknown): Promise<Response> {
  const pairs = Object.entries(query).flatMap(([name, value]) => (value === null ? [] : [[name, String(value)]]));
  const text = new URLSearchParams(pairs).toString();
  const response = await fetch(`/api/${path}${text === "" ? "" : `?${text}`}`, {
    method,
    headers: { authorization: `Bearer ${sessionStorage.getItem(TOKEN) ?? ""}` },
    cache: "no-store",
    ...(body === null ? {} : { body: JSON.stringify(body) }),
  });
  if (response.ok) return response;
  const answer: unknown = await response.json();
  const problem = typeof answer === "object" && answer !== null && "problem" in answer ? String(answer.problem) : response.statusText;
  throw new Refused(response.status, problem);
}

async function ask<T>(path: string, query: Query, method = "GET", body: unknown = null): Promise<T> {
  return (await (await fetched(path, query, method, body)).json()) as T;
}

export const api = {
  about: () => ask<About>("about", {}),
  run: (log: number, at: number | null, epoch: number, version: number, about: number | null) =>
    ask<Frame>("run", { log, at, epoch, version, about }),
  task: (log: number) => ask<Task>("task", { log }),
  world: (log: number, at: number | null, epoch: number, filter: string) => ask<World>("world", { log, at, epoch, filter }),
  robot: (log: number) => ask<Robot>("robot", { log }),
  mesh: async (log: number, mesh: number) => (await fetched("mesh", { log, mesh }, "GET", null)).arrayBuffer(),
  cell: (log: number, at: number | null, epoch: number, version: number) => ask<Cell>("cell", { log, at, epoch, version }),
  system: () => ask<System>("system", {}),
  tail: (worker: string) => ask<Tail>("tail", { worker }),
  scale: (host: string, template: string, min: string, max: string, spares: string) =>
    ask<Told>("scale", { host, template, min, max, spares }, "POST"),
  annotations: () => ask<Annotations>("annotations", {}),
  checkAnnotations: (proposal: Proposal) => ask<Proposed>("annotations/check", {}, "POST", proposal),
  gainOfAnnotations: (proposal: Proposal) => ask<Gained>("annotations/gain", {}, "POST", proposal),
  saveAnnotations: (proposal: Proposal) => ask<Told>("annotations/save", {}, "POST", proposal),
  control: (log: number, word: string) => ask<Told>("control", { log, word }, "POST"),
  answer: (log: number, state: string, choice: string) => ask<Told>("control", { log, word: "answer", state, choice }, "POST"),
  breakAt: (log: number, state: string) => ask<Told>("control", { log, word: "break", state }, "POST"),
  clearBreakpoint: (log: number, state: string) => ask<Told>("control", { log, word: "clear", state }, "POST"),
  signal: (log: number, signal: string) => ask<Told>("control", { log, word: "signal", signal }, "POST"),
};
