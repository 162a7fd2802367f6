// What there is to say of one instance, beside the chart or the network.

import { type Child, h, seconds } from "./dom";
import { jobText, stageText, waited } from "./say";
import type { Store } from "./store";

/** `more` is said, and can be pressed, of the state that is chosen. */
export function details(store: Store, choose: (id: number) => void, more: (state: string) => Child[]): Child[] {
  const one = store.selected === null ? undefined : store.instances.get(store.selected);
  if (one === undefined) return [h("h2", {}, "What waits"), ...waitingList(store, choose)];
  const link = (id: number, text: string) =>
    h("button", { class: "link", "data-key": `edge ${id} ${text}`, onclick: () => choose(id) }, text);
  const why = store.why(one.id);
  const list = (title: string, lines: string[]): Child[] =>
    lines.length === 0 ? [] : [h("h2", {}, title), h("ul", { class: "plain" }, ...lines.map((line) => h("li", {}, line)))];
  return [
    h("h2", { "data-chosen": one.path }, one.path),
    h(
      "dl",
      {},
      h("dt", {}, "is"),
      h("dd", {}, `${stageText(one)} since ${seconds(one.since_s)}`),
      ...(one.outcome === null ? [] : [h("dt", {}, "outcome"), h("dd", {}, one.outcome)]),
      ...(one.decision === null ? [] : [h("dt", {}, "decided"), h("dd", {}, one.decision)]),
      ...(one.reused ? [h("dt", {}, "result"), h("dd", {}, "taken from an equal one")] : []),
      h("dt", {}, "instance"),
      h("dd", {}, `${one.id}, expanded at ${seconds(one.expanded_s)}`),
    ),
    why !== null && h("p", { class: "warn" }, why),
    ...more(one.state),
    ...list(
      "What was done for it",
      one.jobs.map((job) => jobText(job, store.at)),
    ),
    ...list("What it waited for", waited(one)),
    ...list("Why its result did not count", one.invalidations),
    ...(store.edges(one).length === 0
      ? []
      : [
          h("h2", {}, "What it depended on"),
          h(
            "ul",
            { class: "plain" },
            ...store.edges(one).map((edge) => {
              const from = store.instances.get(edge.from);
              return h("li", {}, `${edge.kind}: `, from === undefined ? "one that is not kept any more" : link(edge.from, from.path));
            }),
          ),
        ]),
    h("p", {}, h("button", { "data-key": "unchoose", onclick: () => choose(-1) }, "Show all that waits")),
  ];
}

export function waitingList(store: Store, choose: (id: number) => void): Child[] {
  const waiting = store.frame?.waiting ?? [];
  if (waiting.length === 0) return [h("p", { class: "faint" }, "Nothing waits.")];
  return [
    h(
      "ul",
      { class: "plain", id: "waiting" },
      ...waiting.map((one) =>
        h(
          "li",
          {},
          h("button", { class: "link", "data-key": `waiting ${one.id}`, onclick: () => choose(one.id) }, one.sentence),
          h("span", { class: "faint" }, ` since ${seconds(one.since_s)}`),
        ),
      ),
    ),
  ];
}
