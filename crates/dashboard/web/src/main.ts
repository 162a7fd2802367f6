// The dashboard: which page is shown, of which log, at which moment, and asking for what has changed.

import { annotationsPage } from "./annotations";
import { Refused, api, takeToken } from "./api";
import { confirm } from "./confirm";
import { count, fill, h, seconds } from "./dom";
import { type Page, type Site, cellPage, comparePage, hostsPage, networkPage, resourcesPage, runPage, worldPage } from "./pages";
import { Store } from "./store";
import { type Theme, applyTheme, colour, nextTheme, theme } from "./theme";
import type { About, Awaits, Run, Told } from "./wire";

const PERIOD_MS = 300;
const SLOW_MS = 1_000;
const SPEEDS = [0.5, 1, 2, 5, 10, 50, 200];
const NAMES = { run: "Run", network: "Network", resources: "Resources", hosts: "Hosts and pools", world: "World", cell: "Cell", compare: "Compare", annotations: "Annotations" } as const;
type Name = keyof typeof NAMES;

takeToken();
applyTheme();

const store = new Store();
let about: About | null = null;
let log: number | null = null;
/** The moment that is replayed; none while the newest is shown. */
let moment: number | null = null;
let playing: { from: number; since: number } | null = null;
let speed = 1;
let page: Page;
let name: Name = "run";
let wake: (() => void) | null = null;

const site: Site = {
  store,
  log: () => log,
  logs: () => about?.logs ?? [],
  controls: () => about?.control ?? false,
  told,
  moment: () => moment,
  plays: () => playing !== null,
  colour,
  choose: (id) => {
    store.selected = id < 0 ? null : id;
    page.update();
    say(store.selected === null ? "" : `chosen: ${store.instances.get(store.selected)?.path ?? ""}`);
    hurry();
  },
  go: (to) => {
    location.hash = `#/${to}`;
  },
};
const pages: Record<Name, Page> = {
  run: runPage(site),
  network: networkPage(site),
  resources: resourcesPage(site),
  hosts: hostsPage(site),
  world: worldPage(site),
  cell: cellPage(site),
  compare: comparePage(site),
  annotations: annotationsPage({ say: (text) => say(text) }),
};
page = pages.run;

// What is around the page.
const announcer = h("p", { class: "hidden-text", "aria-live": "polite" });
const links = new Map<Name, HTMLAnchorElement>();
for (const [key, text] of Object.entries(NAMES)) links.set(key as Name, h("a", { href: `#/${key}`, hidden: key === "annotations" }, text));
const logs = h("select", { "aria-label": "Event log" });
const themeButton = h("button", { onclick: () => showTheme(nextTheme()) });
const controls = h("span", { class: "row", role: "group", "aria-label": "Control of the run" });
const summary = h("div", { class: "summary", role: "region", "aria-label": "The run", tabindex: 0 });
const questions = h("section", { class: "questions", hidden: true, "aria-label": "Questions and signals" });
const problem = h("div", { class: "problem", role: "alert", hidden: true });
const live = h("button", { "aria-pressed": "true", onclick: () => showAt(null) }, "Live");
const play = h("button", { onclick: () => (playing === null ? begin() : halt()) }, "Play");
const slider = h("input", { type: "range", min: 0, max: 1, step: "any", value: 1, "aria-label": "Moment that is shown" });
const shownAt = h("output", {});
const pace = h(
  "select",
  { "aria-label": "Speed of the replay", onchange: () => ((speed = Number(pace.value)), playing === null || begin()) },
  ...SPEEDS.map((value) => h("option", { value, selected: value === 1 }, `${value} ×`)),
);
const header = h(
  "header",
  { class: "top" },
  h("a", { class: "skip", href: "#page", onclick: (event) => (event.preventDefault(), page.element.focus()) }, "To the page"),
  h("h1", {}, "ratn"),
  logs,
  h("nav", { "aria-label": "Pages" }, ...links.values()),
  controls,
  h("span", { class: "push" }, themeButton),
);
const footer = h("footer", { "aria-label": "Replay" }, live, play, pace, slider, shownAt);
const app = document.getElementById("app");
app?.append(header, h("div", {}, problem, summary, questions, announcer), page.element, footer);

/** What stands for the colours where there is no room for words. */
const SIGNS: Record<Theme, string> = { auto: "◐", light: "○", dark: "●" };

function showTheme(now: Theme): void {
  const text = now === "auto" ? "Colours: as the system" : `Colours: ${now}`;
  fill(themeButton, h("span", { class: "sign", "aria-hidden": "true" }, SIGNS[now]), h("span", { class: "wordy" }, text));
  themeButton.title = text;
  page.update();
}

function say(text: string): void {
  announcer.textContent = text;
}

function complain(text: string): void {
  problem.hidden = text === "";
  if (problem.textContent !== text) problem.textContent = text;
}

function route(): void {
  const wanted = location.hash.replace(/^#\//, "");
  name = wanted in NAMES ? (wanted as Name) : "run";
  const next = pages[name];
  if (next !== page) page.element.replaceWith(next.element);
  page = next;
  for (const [key, link] of links) {
    if (key === name) {
      link.setAttribute("aria-current", "page");
      link.scrollIntoView({ block: "nearest", inline: "nearest" });
    }
    else link.removeAttribute("aria-current");
  }
  document.title = `${NAMES[name]} – ratn`;
  page.begin();
  page.update();
  hurry();
}

function hurry(): void {
  wake?.();
}

function rest(milliseconds: number): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, milliseconds);
    wake = () => {
      clearTimeout(timer);
      resolve();
    };
  });
}

/** Shows a moment, or the newest. */
function showAt(at: number | null): void {
  halt();
  moment = at;
  hurry();
}

function begin(): void {
  const last = store.run?.last_s ?? 0;
  const from = moment === null || moment >= last ? (store.run?.from_s ?? 0) : moment;
  playing = { from, since: performance.now() };
  moment = from;
  play.textContent = "Stop";
  hurry();
}

function halt(): void {
  playing = null;
  play.textContent = "Play";
}

slider.addEventListener("input", () => showAt(Number(slider.value)));

function choose(id: number): void {
  if (id === log) return;
  log = id;
  halt();
  moment = null;
  taskOf = null;
  store.clear();
  page.update();
  hurry();
}

/** The run that its user did not want to look at. */
let declined: number | null = null;
logs.addEventListener("change", () => {
  const id = Number(logs.value);
  declined = about?.logs.find((one) => one.live && one.id !== id)?.id ?? null;
  choose(id);
});

function showLogs(now: About): void {
  about = now;
  const editor = links.get("annotations");
  if (editor !== undefined) editor.hidden = now.edit === "";
  if (now.edit === "" && name === "annotations") location.hash = "#/run";
  // A run that begins is what somebody wants to see who looks at one that has ended.
  const begun = now.logs.find((one) => one.live && one.id !== log && one.id !== declined);
  const gone = !now.logs.some((one) => one.id === log);
  const next = gone ? (now.logs.find((one) => one.live) ?? now.logs[0]) : undefined;
  if (next !== undefined) choose(next.id);
  else if (begun !== undefined && !now.logs.some((one) => one.id === log && one.live) && moment === null && store.run?.outcome != null) {
    choose(begun.id);
    say(`a run has begun: ${begun.name}`);
  }
  const text = JSON.stringify([now.logs, log]);
  if (logs.dataset["of"] !== text) {
    logs.dataset["of"] = text;
    fill(logs, ...now.logs.map((one) => h("option", { value: one.id, title: one.path, selected: one.id === log }, `${one.name}${one.live ? " (live)" : ""}`)));
    logs.hidden = now.logs.length === 0;
  }
  if (now.logs.length === 0) {
    fill(summary, h("span", {}, `No run is under way in ${now.directory}. `), h("span", { class: "faint" }, "Begin one with `ratn run`; it is shown as soon as it begins."));
  }
}

let controlsOf = "";
function showControls(run: Run): void {
  const of = `${run.controllable} ${run.paused} ${run.id}`;
  if (of === controlsOf) return;
  controlsOf = of;
  if (!run.controllable) {
    fill(controls);
    return;
  }
  const button = (word: string, text: string, question: string, kind = "") =>
    h("button", { class: kind, "data-key": word, onclick: () => ask(word, text, question) }, text);
  fill(
    controls,
    run.paused
      ? button("resume", "Go on", "The run goes on: motions begin again.")
      : button("pause", "Pause", "No further motion begins; what runs goes on to its end."),
    button("step", "Step", "One more motion begins, then the run is paused."),
    button("abort", "End the run", "The run ends: what moves stops and holds, and everything is given back. This cannot be undone.", "danger"),
  );
}

/** Nothing is told to a run that its user has not confirmed. */
function ask(word: string, text: string, question: string): void {
  const of = log;
  if (of === null) return;
  confirm(`${text}?`, text, [h("p", {}, `${store.run?.task ?? ""}: ${question}`)], word === "abort", () => told(api.control(of, word)));
}

let questionsOf = "";
/** What states ask and wait for; whoever may steer the run answers. */
function showQuestions(run: Run): void {
  const asked = run.awaits.filter((one) => one.kind !== "other");
  const of = JSON.stringify([asked, run.controllable]);
  if (of === questionsOf) return;
  questionsOf = of;
  questions.hidden = asked.length === 0;
  const name = store.run?.task ?? "";
  const item = (one: Awaits) => {
    const until = one.until_s === null ? "" : `, until ${seconds(one.until_s)}`;
    const text = one.kind === "answer" ? one.text : `waits for the signal ${one.text}`;
    const act = (label: string, question: string, send: (log: number) => Promise<Told>) =>
      h(
        "button",
        {
          "data-key": `${one.path} ${label}`,
          onclick: () => {
            const to = log;
            if (to !== null) confirm(`${label}?`, label, [h("p", {}, `${name}, ${one.path}: ${question}`)], false, () => told(send(to)));
          },
        },
        label,
      );
    const buttons =
      one.kind === "answer"
        ? one.choices.map((choice) => act(choice, one.text, (to) => api.answer(to, one.path, choice)))
        : [act("Send it", `the signal ${one.text} ends this wait.`, (to) => api.signal(to, one.text))];
    const rest = run.controllable ? buttons : [h("span", { class: "faint" }, one.choices.join(", "))];
    return h("li", { class: "row" }, h("b", {}, one.path), h("span", {}, `${text}${until}`), ...rest);
  };
  fill(questions, h("ul", { class: "plain" }, ...asked.map(item)));
  if (asked.length > 0) say(`${asked.length === 1 ? "a state waits" : "states wait"} for an answer or a signal`);
}

/** Says what came of it. */
function told(answer: Promise<Told>): void {
  answer.then(
    ({ said }) => {
      say(said);
      complain("");
      hurry();
    },
    (error: unknown) => complain(error instanceof Error ? error.message : String(error)),
  );
}

let saidState = "";
function showSummary(run: Run): void {
  const badge = (text: string, kind: string) => h("span", { class: `badge ${kind}` }, text);
  const state =
    run.outcome !== null
      ? badge(run.outcome, run.outcome === "success" ? "" : "bad")
      : moment !== null
        ? badge("replayed", "")
        : run.live
          ? run.paused
            ? badge(run.stopped_at === null ? "paused" : `paused before ${run.stopped_at}`, "paused")
            : badge("live", "live")
          : badge("ended without an outcome, or not heard of", "bad");
  // Screen readers hear when it changes, not every time that it is looked at.
  const now = `${run.task}: ${state.textContent ?? ""}`;
  if (now !== saidState) say(now);
  saidState = now;
  const ahead = run.useful + run.wasted === 0 ? null : h("span", {}, `ahead of time: ${count(run.useful)} of use (${seconds(run.useful_s)}), ${count(run.wasted)} discarded (${seconds(run.wasted_s)})`);
  fill(
    summary,
    h("b", {}, run.task),
    h("span", {}, `${run.mode}`),
    state,
    h("span", {}, `${count(run.retired)} of ${count(run.expanded - run.squashed)} known states have ended`),
    ahead,
    run.breakpoints.length > 0 && h("span", { title: run.breakpoints.join("\n") }, `breakpoints: ${run.breakpoints.join(", ")}`),
    run.problem !== "" && h("span", { class: "bad" }, run.problem),
    run.reason !== "" && h("span", { class: "bad" }, run.reason),
    run.from_s > 0 && h("span", { class: "warn" }, `read from ${seconds(run.from_s)} on: the log is long`),
    run.parameters.length > 0 && h("span", { class: "faint parameters", title: run.parameters.join("\n") }, run.parameters.join(", ")),
  );
  showControls(run);
  showQuestions(run);
}

function showSlider(run: Run): void {
  slider.max = String(Math.max(run.last_s, 0.001));
  if (document.activeElement !== slider || moment === null || playing !== null) slider.value = String(run.at_s);
  slider.setAttribute("aria-valuetext", seconds(run.at_s));
  shownAt.textContent = `${seconds(run.at_s)} of ${seconds(run.last_s)}`;
  live.setAttribute("aria-pressed", String(moment === null));
  live.textContent = run.live ? "Live" : "End";
}

let taskOf: number | null = null;

/** One question for what has changed. Whether there is more at once. */
async function look(): Promise<boolean> {
  if (log === null) return false;
  if (playing !== null) {
    moment = playing.from + ((performance.now() - playing.since) / 1000) * speed;
    const last = store.run?.last_s ?? Infinity;
    if (moment >= last) {
      halt();
      moment = store.run?.live === true ? null : last;
    }
  }
  const [of, isReplay] = [log, moment !== null];
  const frame = await api.run(of, moment, store.frame?.epoch ?? 0, store.frame?.version ?? 0, store.selected);
  // Something else was chosen meanwhile.
  if (of !== log || isReplay !== (moment !== null)) return true;
  store.apply(frame);
  if (store.task === null && taskOf !== of && frame.run.task !== "") {
    // Once for each log: a task file is read, and not while something waits for the answer.
    taskOf = of;
    api.task(of).then(
      (task) => {
        if (of === log) store.setTask(task);
      },
      () => undefined,
    );
  }
  showSummary(frame.run);
  showSlider(frame.run);
  page.update();
  await page.follow?.();
  return frame.more;
}

async function loop(): Promise<void> {
  let [slow, polled] = [0, 0];
  for (;;) {
    let pause = PERIOD_MS;
    if (document.hidden) {
      await rest(SLOW_MS);
      continue;
    }
    try {
      if (performance.now() - slow >= SLOW_MS || about === null) {
        slow = performance.now();
        showLogs(await api.about());
        complain(about?.problem ?? "");
      }
      if (await look()) pause = 0;
      else if (playing !== null) pause = 60;
      if (page.poll !== undefined && performance.now() - polled >= SLOW_MS) {
        polled = performance.now();
        await page.poll();
      }
    } catch (error) {
      if (error instanceof Refused && error.status === 404 && about !== null) about = { ...about, logs: [] };
      complain(error instanceof TypeError ? "the dashboard does not answer: has `ratn dashboard` ended?" : String(error instanceof Error ? error.message : error));
      pause = SLOW_MS;
    }
    if (pause > 0) await rest(pause);
  }
}

document.addEventListener("visibilitychange", hurry);
addEventListener("hashchange", route);
showTheme(theme());
route();
void loop();
