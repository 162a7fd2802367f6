// What is said of an instance in words, for hints and screen readers.

import { pausesBefore } from "./breakpoints";
import { seconds } from "./dom";
import type { Store } from "./store";
import type { Instance, Job, Phase, Wait } from "./wire";

const LONGEST = 3;

export function lastName(path: string): string {
  return path.slice(path.lastIndexOf("/") + 1);
}

export function parent(path: string): string {
  const cut = path.lastIndexOf("/");
  return cut < 0 ? "" : path.slice(0, cut);
}

/** What it waited for before it ran, the longest first. */
export function waited(one: Instance): string[] {
  const lines: { length: number; text: string }[] = one.waits
    .filter((wait) => wait.to_s > wait.from_s)
    .map((wait) => ({ length: wait.to_s - wait.from_s, text: waitText(wait) }));
  for (const phase of one.phases) {
    if (phase.stage === "waiting") lines.push({ length: phase.to_s - phase.from_s, text: phaseText(phase) });
  }
  return lines
    .sort((a, b) => b.length - a.length)
    .slice(0, LONGEST)
    .map((line) => line.text);
}

function waitText(wait: Wait): string {
  const behind = wait.behind.length === 0 ? "" : `: ${wait.behind.join(", ")}`;
  return `waited ${seconds(wait.to_s - wait.from_s)} for ${wait.kinds.join(", ") || "resources"}${behind}`;
}

function phaseText(phase: Phase): string {
  return `waited ${seconds(phase.to_s - phase.from_s)} for ${phase.awaited}`;
}

export function jobText(job: Job, now: number): string {
  const to = job.to_s ?? now;
  const ending = job.to_s === null ? "running" : job.ending;
  const on = job.resources.length === 0 ? "" : ` on ${job.resources.join(", ")}`;
  const reason = job.reason === "" ? "" : `: ${job.reason}`;
  const worth = job.worth === "lost" ? ", discarded" : "";
  return `${job.action}${on}, ${seconds(job.from_s)} to ${seconds(to)} (${seconds(to - job.from_s)}), ${ending}${worth}${reason}`;
}

export function hint(store: Store, one: Instance, job: Job | null): string {
  const lines = [one.path];
  if (job !== null) lines.push(jobText(job, store.at));
  lines.push(`${stageText(one)} since ${seconds(one.since_s)}`);
  if (pausesBefore(store.run?.breakpoints ?? [], one.state)) lines.push("breakpoint: the run pauses before it");
  const why = store.why(one.id);
  if (why !== null) lines.push(why);
  lines.push(...waited(one));
  return lines.join("\n");
}

export function stageText(one: Instance): string {
  const guess = one.speculative && one.stage !== "retired" && one.stage !== "squashed" ? ", speculative" : "";
  const stage = one.stage === "squashed" ? "discarded" : one.stage === "retired" ? "real" : one.stage;
  return `${stage}${guess}`;
}
