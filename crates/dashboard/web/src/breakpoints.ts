// Before which states the run pauses: shown to everybody, set and cleared by whoever may steer the run.

import { api } from "./api";
import { confirm } from "./confirm";
import { type Child, count, fill, h } from "./dom";
import type { Store } from "./store";
import type { Told } from "./wire";

/** States in the list; of more the search shows others. */
const MOST = 300;

/** What steering needs. */
export interface Steering {
  readonly store: Store;
  log(): number | null;
  told(answer: Promise<Told>): void;
}

/** Whether a run pauses before a state, without visits: a breakpoint is at it or at what is around it. */
export function pausesBefore(breakpoints: string[], state: string): boolean {
  return breakpoints.length > 0 && breakpoints.some((path) => path === state || state.startsWith(`${path}/`));
}

/** Nothing is set or taken away that its user has not confirmed. */
function ask({ store, log, told }: Steering, state: string, set: boolean): void {
  const of = log();
  if (of === null) return;
  const title = set ? `Pause before ${state}?` : state === "" ? "Take all breakpoints away?" : `No more pause before ${state}?`;
  const text = set
    ? "When it, or something inside of it, would begin that may change the environment, the run is paused. Each visit pauses again."
    : "A run that is paused stays so until it goes on.";
  const yes = set ? "Set the breakpoint" : state === "" ? "Take all away" : "Take it away";
  const content = [h("p", {}, `${store.run?.task ?? ""}: ${text}`)];
  confirm(title, yes, content, false, () => told(set ? api.breakAt(of, state) : api.clearBreakpoint(of, state)));
}

/** What there is to say and to press of one state. */
export function breakpointOf(steering: Steering, state: string): Child[] {
  const { store } = steering;
  const { run, task } = store;
  if (run === null) return [];
  const { breakpoints } = run;
  const around = breakpoints.filter((path) => path !== state && state.startsWith(`${path}/`));
  const is = breakpoints.includes(state);
  // Where the task file is not known, the run says whether it can stop there.
  const may = run.controllable && (is || task?.known !== true || task.stops.includes(state));
  const press = h(
    "button",
    { "data-key": "breakpoint", onclick: () => ask(steering, state, !is) },
    is ? "Take its breakpoint away" : "Pause before it",
  );
  return [
    is && h("p", {}, `Breakpoint: the run pauses before each visit of ${state}.`),
    around.length > 0 && h("p", {}, `The run pauses before it: a breakpoint is at ${around.join(", ")}.`),
    may && h("p", {}, press),
  ];
}

/** The list of states at which a run can stop. Told when something has changed. */
export class Breakpoints {
  readonly element: HTMLElement;
  private readonly list = h("ul", { class: "tree", tabindex: 0, "aria-label": "Breakpoints" });
  private readonly summary = h("summary", {});
  private known = "";

  constructor(
    private readonly steering: Steering,
    private readonly search: () => string,
  ) {
    this.element = h("details", {}, this.summary, this.list);
  }

  update(): void {
    const { run, task } = this.steering.store;
    const breakpoints = run?.breakpoints ?? [];
    const search = this.search().toLowerCase();
    const stops = run?.controllable === true ? (task?.stops ?? []) : [];
    const all = [...breakpoints, ...stops.filter((path) => !breakpoints.includes(path) && path.toLowerCase().includes(search))];
    const text = JSON.stringify([all, breakpoints, run?.controllable]);
    if (text === this.known) return;
    this.known = text;
    this.element.hidden = all.length === 0;
    this.summary.textContent = breakpoints.length === 0 ? "Breakpoints" : `Breakpoints (${count(breakpoints.length)})`;
    const item = (path: string) => {
      const is = breakpoints.includes(path);
      if (run?.controllable !== true) return h("li", {}, path);
      const press = () => ask(this.steering, path, !is);
      return h("li", {}, h("button", { class: "link", "aria-pressed": String(is), "data-key": `break ${path}`, onclick: press }, `${is ? "●" : "○"} ${path}`));
    };
    const more = all.length - MOST;
    fill(
      this.list,
      ...all.slice(0, MOST).map(item),
      more > 0 && h("li", { class: "faint" }, `and ${count(more)} more: say a part of a path`),
      run?.controllable === true &&
        breakpoints.length > 1 &&
        h("li", {}, h("button", { "data-key": "clear all", onclick: () => ask(this.steering, "", false) }, "Take all away")),
    );
  }
}
