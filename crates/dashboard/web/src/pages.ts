// The pages. Each has an element that is made once, and is told when something has changed.

import { Refused, api } from "./api";
import { Breakpoints, breakpointOf } from "./breakpoints";
import type { CellView } from "./cell";
import { confirm } from "./confirm";
import { details, waitingList } from "./details";
import { append, bytes, count, fill, h, percent, sample, seconds, table } from "./dom";
import { type By, Gantt } from "./gantt";
import { KINDS, type Level, Network } from "./network";
import { Store } from "./store";
import type { Host, Log, Pool, System, Told, World } from "./wire";
import { View } from "./view";

export interface Page {
  readonly element: HTMLElement;
  readonly wide: boolean;
  /** The run is otherwise than before. */
  update(): void;
  /** The page is shown from now on. */
  begin(): void;
  /** Asks for what the run does not tell; no more often than once a second. */
  poll?(): Promise<void>;
  /** As `poll`, but each time that the run was asked. */
  follow?(): Promise<void>;
}

/** What the pages want of the whole. */
export interface Site {
  readonly store: Store;
  log(): number | null;
  logs(): Log[];
  /** The pages may tell somebody something. */
  controls(): boolean;
  /** Says what came of it. */
  told(answer: Promise<Told>): void;
  moment(): number | null;
  /** A replay goes on. */
  plays(): boolean;
  /** A colour of the style sheet. */
  colour(name: string): string;
  choose(id: number): void;
  go(page: string): void;
}

const ACTIVITIES = [
  ["motion", "moves"],
  ["detection", "looks"],
  ["planning", "plans, ahead of time where it can"],
  ["other", "other work"],
] as const;

function choices<T extends string>(label: string, all: readonly (readonly [T, string])[], now: T, chosen: (value: T) => void): HTMLElement {
  const select = h(
    "select",
    { onchange: () => chosen(select.value as T) },
    ...all.map(([value, text]) => h("option", { value, selected: value === now }, text)),
  );
  return h("label", {}, `${label} `, select);
}

const KEYS = "Arrow keys choose, Shift and arrow keys move, plus and minus zoom, 0 shows all, Enter opens.";

export function runPage(site: Site): Page {
  const { store } = site;
  const kept = sessionStorage.getItem("ratn-by");
  const gantt = new Gantt(store, kept === "node" || kept === "host" ? kept : "resource");
  const open = (id: number) => {
    if (id >= 0) site.choose(id);
    site.go("network");
  };
  const view = new View(`Gantt chart of the run. ${KEYS}`, gantt, open, open);
  const side = h("aside", { "aria-label": "What is chosen, or what waits" });
  const scale = (factor: number) => () => {
    gantt.zoom(factor, view.element.clientWidth / 2);
    view.repaint();
  };
  const by = choices<By>("A row is", [["resource", "a resource"], ["node", "a state"], ["host", "a host"]], gantt.by, (value) => {
    gantt.by = value;
    sessionStorage.setItem("ratn-by", value);
    view.repaint();
  });
  const bar = h(
    "div",
    { class: "row" },
    by,
    h(
      "span",
      { class: "row together" },
      h("button", { "aria-label": "Zoom in", onclick: scale(1.5) }, "+"),
      h("button", { "aria-label": "Zoom out", onclick: scale(1 / 1.5) }, "−"),
      h("button", { onclick: () => (gantt.fit(), view.repaint()) }, "All of it"),
    ),
  );
  const legend = h("div", { class: "legend below" });
  append(legend, ACTIVITIES.map(([kind, text]) => h("span", {}, sample(kind, false), text)));
  append(legend, [h("span", {}, "faded: discarded"), h("span", {}, "dashed: speculative"), h("span", {}, "click: to the node")]);
  const stage = h("div", { class: "stage" }, bar, view.element, legend);
  return {
    element: h("main", { id: "page", class: "wide", tabindex: -1 }, stage, side),
    wide: true,
    begin: () => view.repaint(),
    update: () => {
      view.repaint();
      fill(side, ...runningList(site), h("h2", {}, "What waits"), ...waitingList(store, site.choose));
    },
  };
}

function runningList(site: Site): Node[] {
  const { store } = site;
  const running = [...store.instances.values()].filter((one) => one.stage === "running").slice(0, 30);
  const item = (id: number, path: string, since: number) =>
    h(
      "li",
      {},
      h("button", { class: "link", "data-key": `runs ${id}`, onclick: () => (site.choose(id), site.go("network")) }, path),
      h("span", { class: "faint" }, ` for ${seconds(Math.max(store.at - since, 0))}`),
    );
  return [
    h("h2", {}, "What runs"),
    running.length === 0
      ? h("p", { class: "faint" }, "Nothing runs.")
      : h("ul", { class: "plain", id: "running" }, ...running.map((one) => item(one.id, one.path, one.since_s))),
  ];
}

/** Two runs below each other, on one time axis. */
export function comparePage(site: Site): Page {
  const other = new Store();
  const [upper, lower] = [new Gantt(site.store, "resource"), new Gantt(other, "resource")];
  [upper.beside, lower.beside] = [lower, upper];
  let of: number | null = null;
  let known = "";
  const views: View[] = [];
  const repaint = () => views.forEach((view) => view.repaint());
  // What moves one moves the other.
  const both = (gantt: Gantt) => ({
    paint: gantt.paint.bind(gantt),
    at: gantt.at.bind(gantt),
    pan: (dx: number, dy: number) => (gantt.pan(dx, dy), repaint()),
    zoom: (factor: number, x: number) => (gantt.zoom(factor, x), repaint()),
    fit: () => (gantt.fit(), repaint()),
    step: gantt.step.bind(gantt),
  });
  const choose = (store: Store) => (id: number) => {
    store.selected = id < 0 ? null : id;
    repaint();
  };
  views.push(
    new View(`Gantt chart of the run. ${KEYS}`, both(upper), choose(site.store), choose(site.store)),
    new View(`Gantt chart of the other run. ${KEYS}`, both(lower), choose(other), choose(other)),
  );
  const select = h("select", {});
  select.addEventListener("change", () => {
    of = Number(select.value);
    other.clear();
    void follow().catch(() => undefined);
  });
  const heads = [h("h2", {}), h("h2", {})] as const;
  const head = (store: Store) => {
    const run = store.run;
    return run === null ? "" : `${run.task}, ${run.mode}: ${seconds(run.at_s)}${run.outcome === null ? "" : `, ${run.outcome}`}`;
  };
  const difference = h("p", { class: "faint" });
  const show = () => {
    const logs = site.logs().filter((one) => one.id !== site.log());
    const text = JSON.stringify(logs);
    if (text !== known) {
      known = text;
      if (!logs.some((one) => one.id === of)) {
        of = logs[0]?.id ?? null;
        other.clear();
      }
      fill(select, ...logs.map((one) => h("option", { value: one.id, title: one.path, selected: one.id === of }, one.name)));
      select.disabled = logs.length === 0;
    }
    heads[0].textContent = head(site.store);
    heads[1].textContent = of === null ? "There is no other log: name several to `ratn dashboard`." : head(other);
    const [a, b] = [site.store.run, other.run];
    const ended = a?.outcome === "success" && b?.outcome === "success" && a.task === b.task && b.at_s > 0;
    const share = ended ? (1 - a.at_s / b.at_s) * 100 : 0;
    difference.textContent = ended ? `The upper one is ${percent(Math.abs(share))} ${share >= 0 ? "shorter" : "longer"}.` : "";
    repaint();
  };
  const follow = async () => {
    if (of === null) return;
    for (let more = true; more; ) {
      const asked: number = of;
      const frame = await api.run(asked, site.moment(), other.frame?.epoch ?? 0, other.frame?.version ?? 0, other.selected);
      if (asked !== of) return;
      other.apply(frame);
      more = frame.more;
    }
    show();
  };
  const stage = h("div", { class: "stage two" }, h("div", { class: "row" }, h("label", {}, "Below it ", select), difference), heads[0]);
  append(stage, [views[0]?.element, heads[1], views[1]?.element]);
  return { element: h("main", { id: "page", tabindex: -1 }, stage), wide: true, begin: show, update: show, poll: follow };
}

export function networkPage(site: Site): Page {
  const { store } = site;
  const network = new Network(store);
  const choose = (id: number) => {
    site.choose(id);
  };
  const view = new View(`Network of the task. ${KEYS}`, network, choose, (id) => {
    if (id >= 0) site.choose(id);
  });
  const side = h("aside", { "aria-label": "The instance that is chosen" });
  const tree = h("details", {}, h("summary", {}, "Collapse states"));
  const groups = h("ul", { class: "tree" });
  tree.append(groups);
  const again = () => {
    network.fit();
    view.repaint();
  };
  const search = h("input", { type: "search", placeholder: "part of a path", "aria-label": "Only instances with this in their path" });
  const breakpoints = new Breakpoints(site, () => search.value);
  search.addEventListener("input", () => {
    network.search = search.value;
    breakpoints.update();
    again();
  });
  const edges = KINDS.map((kind) => {
    const box = h("input", { type: "checkbox", checked: true });
    box.addEventListener("change", () => {
      if (box.checked) network.shown.add(kind);
      else network.shown.delete(kind);
      again();
    });
    return h("label", {}, box, " ", sample(kind, true), kind);
  });
  const causes = h("button", { "aria-pressed": "false" }, "Only its causes");
  causes.addEventListener("click", () => {
    network.causes = !network.causes;
    causes.setAttribute("aria-pressed", String(network.causes));
    again();
  });
  const scale = (factor: number) => () => {
    network.zoom(factor, view.element.clientWidth / 2, view.element.clientHeight / 2);
    view.repaint();
  };
  const bar = h(
    "div",
    { class: "row" },
    choices<Level>("Show", [["instances", "as it executes"], ["states", "as it is written"]], network.level, (value) => {
      network.level = value;
      again();
    }),
    choices<"all" | "open" | "waiting">("and of it", [["all", "everything"], ["open", "what is not real yet"], ["waiting", "what waits"]], "all", (value) => {
      network.stages = value;
      again();
    }),
    search,
    causes,
    h(
      "span",
      { class: "row together" },
      h("button", { "aria-label": "Zoom in", onclick: scale(1.4) }, "+"),
      h("button", { "aria-label": "Zoom out", onclick: scale(1 / 1.4) }, "−"),
      h("button", { onclick: () => (network.fit(), view.repaint()) }, "All of it"),
    ),
    tree,
    breakpoints.element,
  );
  const legend = h("div", { class: "row legend" }, "depends on: ", ...edges, h("span", { class: "more" }, "dashed: speculative, faded: discarded, ●: breakpoint"));
  let known = "";
  const note = h("span", { class: "warn" });
  legend.append(note);
  const showGroups = () => {
    const text = network.groups.join("\n");
    if (text === known) return;
    known = text;
    const item = (group: string) => {
      const button = h("button", { class: "link", "aria-pressed": String(network.collapsed.has(group)), "data-key": `group ${group}` }, group);
      button.addEventListener("click", () => {
        if (network.collapsed.has(group)) network.collapsed.delete(group);
        else network.collapsed.add(group);
        button.setAttribute("aria-pressed", String(network.collapsed.has(group)));
        again();
      });
      return h("li", {}, button);
    };
    fill(groups, ...network.groups.map(item));
    tree.hidden = network.groups.length === 0;
  };
  let shown: number | null = null;
  return {
    element: h("main", { id: "page", class: "wide", tabindex: -1 }, h("div", { class: "stage" }, bar, view.element, legend), side),
    wide: true,
    begin: () => {
      shown = null;
      view.repaint();
    },
    update: () => {
      network.layOut();
      showGroups();
      breakpoints.update();
      const unknown = store.task !== null && !store.task.known ? `only what the log tells: ${store.task.note}` : "";
      if (note.textContent !== unknown) note.textContent = unknown;
      causes.disabled = store.selected === null;
      view.element.dataset["nodes"] = String(network.nodes.length);
      if (store.selected !== shown) {
        shown = store.selected;
        if (shown !== null) network.show(shown);
      }
      view.repaint();
      fill(side, ...details(store, site.choose, (state) => breakpointOf(site, state)));
    },
  };
}

export function resourcesPage(site: Site): Page {
  const { store } = site;
  const ofRun = h("section", { "aria-label": "Of the run" });
  const ofSystem = h("section", { "aria-label": "Of the system" });
  const go = (id: number, path: string) =>
    h("button", { class: "link", "data-key": `holder ${id} ${path}`, onclick: () => (site.choose(id), site.go("network")) }, path);
  const show = (system: System) => {
    const rows = system.resources.flatMap((one) => {
      const first = [one.id, one.kind, one.host, one.state, one.free];
      if (one.holdings.length === 0) return [[...first, "", "", ""]];
      return one.holdings.map((holding, index) => [
        ...(index === 0 ? first : ["", "", "", "", ""]),
        holding.holder,
        holding.expires_in_ms === null ? "" : seconds(holding.expires_in_ms / 1000),
        String(holding.token),
      ]);
    });
    const waiting = system.waiting.map((one) => [one.holder, count(one.priority), count(one.ahead), one.obstacles.join("; ") || "its turn"]);
    fill(
      ofSystem,
      h("h2", {}, "The system"),
      system.up ? null : h("p", { class: "faint" }, `No system is up: ${system.problem}`),
      system.up && table("Resources of the system", ["resource", "kind", "host", "state", "free", "holder", "session lives for", "token"], rows, [6, 7]),
      system.up && table("Who waits at the resource manager", ["who", "priority", "before it", "what is in the way"], waiting, [1, 2]),
      system.up &&
        table(
          "Sessions",
          ["session", "who", "lives for", "leases", "resources"],
          system.sessions.map((one) => [one.id, one.client, seconds(one.expires_in_ms / 1000), count(one.leases), count(one.resources)]),
          [2, 3, 4],
        ),
    );
  };
  return {
    element: h("main", { id: "page", tabindex: -1 }, ofRun, ofSystem),
    wide: false,
    begin: () => undefined,
    update: () => {
      const frame = store.frame;
      if (frame === null) return;
      const since = (from: number) => `${seconds(from)}, for ${seconds(Math.max(frame.run.at_s - from, 0))}`;
      fill(
        ofRun,
        h("h2", {}, "The run, as its log tells"),
        table("Kinds", ["kind", "how many", "held by the run"], frame.kinds.map((one) => [one.kind, count(one.total), count(one.held)]), [1, 2]),
        table("Who holds what", ["resource", "kind", "holder", "since"], frame.held.map((one) => [one.resource, one.kind, go(one.instance, one.holder), since(one.from_s)])),
        table(
          "Who waits, the next one first",
          ["who", "for", "priority", "since", "why"],
          frame.queue.map((one) => [go(one.instance, one.path), one.kinds.join(", "), count(one.priority), since(one.from_s), store.why(one.instance) ?? ""]),
          [2],
        ),
      );
    },
    poll: async () => show(await api.system()),
  };
}

/** Asks how many workers a pool shall have. */
function scaleButton(site: Site, host: Host, pool: Pool): HTMLElement {
  const field = (text: string, value: number) => {
    const input = h("input", { type: "number", min: 0, max: 1000, value, size: 6 });
    return { input, label: h("label", {}, `${text} `, input) };
  };
  const ask = () => {
    const [least, most, spares] = [field("At least", pool.min), field("At most", pool.max), field("Spares", pool.spares)];
    const text = `Until the process manager of ${host.name} ends, within what its config allows. Workers beyond that end once nobody holds them.`;
    const content = [h("p", {}, text), h("div", { class: "row" }, least.label, most.label, spares.label)];
    confirm(`How many workers shall ${pool.template} have?`, "Scale the pool", content, false, () =>
      site.told(api.scale(host.name, pool.template, least.input.value, most.input.value, spares.input.value)),
    );
  };
  return h("button", { "data-key": `scale ${host.name} ${pool.template}`, "aria-label": `Scale the pool ${pool.template}`, onclick: ask }, "scale");
}

export function hostsPage(site: Site): Page {
  const hosts = h("section", { "aria-label": "Hosts" });
  const log = h("section", { "aria-label": "Output of a worker", "aria-live": "polite" });
  let of: string | null = null;
  const tail = async () => {
    if (of === null) return;
    try {
      const { text, cut, worker } = await api.tail(of);
      const pre = h("pre", { tabindex: 0, role: "region", "aria-label": `Output of ${worker}`, "data-key": "log" }, cut ? `…\n${text}` : text || "(nothing)");
      fill(log, h("h2", {}, `The end of what ${worker} has written`), pre);
      pre.scrollTop = pre.scrollHeight;
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      fill(log, h("p", { class: "bad" }, error.message));
    }
  };
  const show = (system: System) => {
    const of_host = system.hosts.flatMap((host) => {
      const workers = host.pools.flatMap((pool) => pool.workers.map((worker) => ({ pool, worker })));
      const cpu = workers.reduce((all, { worker }) => all + worker.cpu_millicores, 0);
      const memory = workers.reduce((all, { worker }) => all + worker.resident_bytes, 0);
      const head = h("h2", {}, `Host ${host.name || "(unknown)"}`);
      const state = host.problem !== "" ? host.problem : host.draining ? "drained: takes no new work" : "takes work";
      return [
        head,
        h("p", { class: host.problem === "" ? "faint" : "bad" }, `${state}; its workers use ${seconds(cpu / 1000, 2).replace(/\u00a0s$/, "")} cores and ${bytes(memory)}`),
        table(
          `Pools of ${host.name}`,
          ["pool", "kind", "workers", "least", "most", "spares", "restarts after crashes", "last end", "trouble", ...(site.controls() ? ["size"] : [])],
          host.pools.map((pool) => [pool.template, pool.kind, count(pool.workers.length), count(pool.min), count(pool.max), count(pool.spares), count(pool.crashes), pool.last_exit, pool.failure, ...(site.controls() ? [scaleButton(site, host, pool)] : [])]),
          [2, 3, 4, 5, 6],
        ),
        table(
          `Workers of ${host.name}`,
          ["worker", "state", "held", "process", "age", "CPU", "memory", "limits", "output"],
          workers.map(({ worker }) => [
            worker.id,
            worker.state,
            worker.held ? "held" : "free",
            String(worker.pid),
            seconds(worker.age_s, 0),
            `${count(worker.cpu_millicores / 10)}\u00a0%`,
            bytes(worker.resident_bytes),
            worker.limits,
            h("button", { "data-key": `log ${worker.id}`, "aria-label": `Show the output of ${worker.id}`, onclick: () => ((of = worker.id), void tail()) }, "show"),
          ]),
          [3, 4, 5, 6],
        ),
      ];
    });
    fill(hosts, ...(system.up ? of_host : [h("p", { class: "faint" }, `No system is up: ${system.problem}`)]));
  };
  return {
    element: h("main", { id: "page", tabindex: -1 }, hosts, log),
    wide: false,
    begin: () => undefined,
    update: () => undefined,
    poll: async () => {
      show(await api.system());
      await tail();
    },
  };
}

export function worldPage(site: Site): Page {
  const filter = h("input", { type: "search", placeholder: "fact, value or writer", "aria-label": "Only facts with this in key, value or writer" });
  const body = h("section", { "aria-label": "Facts" });
  const ask = async () => {
    const log = site.log();
    if (log === null) return;
    show(await api.world(log, site.moment(), site.store.frame?.epoch ?? 0, filter.value));
  };
  filter.addEventListener("input", () => void ask().catch(() => undefined));
  const show = (world: World) => {
    const history = world.history.map((one) => [seconds(one.at_s), count(one.revision), one.key, one.before ?? "—", one.after ?? "gone", one.writer]);
    const more = world.fitting > world.facts.length ? `, the first ${count(world.facts.length)}` : "";
    const partial = world.from_s > 0 ? h("p", { class: "warn" }, `The log was read from ${seconds(world.from_s)} on: what was written between the start and then is not here.`) : null;
    fill(
      body,
      partial,
      table(
        `Facts of the root at ${seconds(world.at_s)}, revision ${count(world.revision)}: ${count(world.fitting)} of ${count(world.all)}${more}`,
        ["fact", "value", "written by", "at", "revision"],
        world.facts.map((one) => [one.key, one.value, one.writer, seconds(one.at_s), count(one.revision)]),
        [3, 4],
      ),
      ...world.projections.map((one) =>
        table(
          `Projection of ${one.path}, over revision ${count(one.base)}`,
          ["fact", "in the root", "in the projection", "to be written by"],
          one.changes.map((change) => [change.key, change.root ?? "—", change.change, change.writer]),
        ),
      ),
      table("What was written last", ["at", "revision", "fact", "before", "after", "written by"], history, [0, 1]),
    );
  };
  return {
    element: h("main", { id: "page", tabindex: -1 }, h("div", { class: "row" }, h("label", {}, "Filter ", filter)), body),
    wide: false,
    begin: () => undefined,
    update: () => undefined,
    poll: ask,
  };
}

/** What only this page needs, from a file of its own. */
const CELL = "/cell.js";

export function cellPage(site: Site): Page {
  const element = h("main", { id: "page", class: "wide", tabindex: -1 });
  let view: Promise<CellView> | null = null;
  const load = async () => {
    const { CellView } = (await import(CELL)) as typeof import("./cell");
    return new CellView(element, site);
  };
  const shown = () => (view ??= load());
  return {
    element,
    wide: true,
    begin: () => void shown().then((view) => view.begin(), () => (view = null)),
    update: () => void view?.then((view) => view.repaint(), () => undefined),
    follow: async () => (await shown()).follow(),
  };
}
