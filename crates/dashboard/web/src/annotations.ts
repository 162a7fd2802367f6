// The page "Annotations": the states of a task file with what is in force for each, and a form that changes what one says itself.
//
// What is typed is checked by the program that served the page, with the checks of `ratn check`; nothing is written before its user has
// confirmed it.

import { Refused, api } from "./api";
import { confirm } from "./confirm";
import { type Child, append, fill, h, percent, seconds } from "./dom";
import type { Page } from "./pages";
import type { AnnotatedState, AnnotationKey, Annotations, Finding, Gained, InForceLine, Proposed } from "./wire";

/** What a state shall say under a key; without items the key is not there any more. */
export interface Change {
  key: string;
  items: string[] | null;
}

export interface Proposal {
  digest: string;
  state: string;
  changes: Change[];
}

/** What is in the form: of each key whether the state says something, and what. */
export type Draft = Map<string, { said: boolean; items: string[] }>;

const DEBOUNCE_MS = 350;
const ABOUT: Record<string, string> = {
  computes: "it only computes, and may run early, twice, or for nothing",
  pia: "it may change the environment: as every action that says neither this nor one of the two above",
  reads: "the facts that it depends on; scene for those that geometry comes from",
  senses: "the facts that must be as at its place when it looks",
  requires: "conditions that must hold before it begins",
  effects: "what it changes: at(cup) = pose, not hand_empty(gripper)",
  resources: "what it asks of the resource manager: { block: Arm }",
  duration: "an estimate, in the robot's seconds",
  attempts: "how often it is tried when its worker dies, if it computes or senses",
  deterministic: "the same inputs and facts always give the same result",
  routine: "it and what it contains are one node, under one lease",
  exceptional: "outcomes that are not followed ahead, although they are connected: aborted",
  exceptions: "imprecise: younger PIAs may run beside it",
  shared: "of a region: facts that the regions beside it may touch, too",
};
/** Of those that few states say, shown only when they are wanted. */
const RARE = ["attempts", "deterministic", "routine", "exceptional", "exceptions", "shared"];
/** What a key is as soon as it is said. */
const FIRST: Record<string, string> = { computes: "true", pia: "true", attempts: "3", deterministic: "true", routine: "true", exceptional: "aborted", exceptions: "imprecise" };
const REFUSED = "The file is refused as it is, and still is with this change.";
/** More words are no help. */
const MOST_WORDS = 500;

export function draftOf(state: AnnotatedState): Draft {
  return new Map(state.keys.map((one) => [one.key, { said: one.said, items: [...one.items] }]));
}

/** What of a draft is otherwise than the file. Items that are empty count for nothing. */
export function changesOf(state: AnnotatedState, draft: Draft): Change[] {
  return state.keys.flatMap((one) => {
    const now = draft.get(one.key);
    if (now === undefined) return [];
    const items = now.items.map((item) => item.trim()).filter((item) => item !== "");
    // A value of which nothing is left is not there.
    const said = now.said && (one.listed || items.length > 0);
    const isSame = said === one.said && (!said || JSON.stringify(items) === JSON.stringify(one.items));
    return isSame ? [] : [{ key: one.key, items: said ? items : null }];
  });
}

/** What is said first of a key of which nothing is said yet; a field that is shown empty says nothing. */
export function begin(key: string, items: string[]): void {
  if (items.every((item) => item.trim() === "")) items.splice(0, items.length, FIRST[key] ?? "");
}

/** Findings of a state by key, those of the state that are of no key of the form, and all others. */
export function sorted(findings: Finding[], state: string, keys: string[]): { byKey: Map<string, Finding[]>; own: Finding[]; others: Finding[] } {
  const byKey = new Map<string, Finding[]>();
  const [own, others]: [Finding[], Finding[]] = [[], []];
  for (const one of findings) {
    if (one.path !== state) others.push(one);
    else if (!keys.includes(one.key)) own.push(one);
    else byKey.set(one.key, [...(byKey.get(one.key) ?? []), one]);
  }
  return { byKey, own, others };
}

/** Whether a change that was checked may be saved: a file that is refused already may be, so that it can be mended step by step. */
export function maySave(changes: Change[], checked: Proposed | null, findings: Finding[]): boolean {
  if (changes.length === 0 || checked === null || checked.problem !== "") return false;
  return !checked.refused || isRefused(findings);
}

/** Whether the file as it is is refused. */
export function isRefused(findings: Finding[]): boolean {
  return findings.some((one) => one.severity === "error");
}

/** Whether somebody has typed on since this was sent. */
export function isOther(sent: Proposal, now: Proposal): boolean {
  return sent.state === now.state && JSON.stringify(sent.changes) !== JSON.stringify(now.changes);
}

/** What a change gains, in a sentence. */
export function gainText(gained: Gained): string {
  const { before_s: before, after_s: after, obstacle } = gained;
  if (before !== null && after !== null) {
    const difference = before - after;
    const now = `With the change ${seconds(after)}, without it ${seconds(before)}, by simulation in CDTN mode`;
    if (Math.abs(difference) < 0.05) return `${now}: nothing is gained.`;
    const share = before > 0 ? ` (${percent((Math.abs(difference) / before) * 100)})` : "";
    return `${now}: ${seconds(Math.abs(difference))} ${difference > 0 ? "shorter" : "longer"}${share}.`;
  }
  const known = before !== null ? ` As it is: ${seconds(before)}.` : after !== null ? ` With the change: ${seconds(after)}.` : "";
  return `What it gains cannot be said: ${obstacle}.${known}`;
}

type Words = Pick<Annotations, "kinds" | "predicates" | "entities" | "places">;

/** What may stand at a place of a predicate, which is given as `on(?, ?)`. */
function offeredAt(predicate: string, place: number, all: Words): string[] {
  return all.places.find((one) => one.predicate === predicate)?.offered[place] ?? all.entities;
}

/** How many places a predicate has that is given as `on(?, ?)`. */
function arity(predicate: string): number {
  return predicate.endsWith("()") ? 0 : predicate.split(",").length;
}

/** Words for completion under a key. */
export function wordsFor(key: string, all: Words): string[] {
  const { kinds, predicates } = all;
  // Of predicates with several places each is completed as it is typed.
  const facts = predicates.flatMap((one) => (arity(one) === 1 ? offeredAt(one, 0, all).map((entity) => one.replace("?", () => entity)) : []));
  const words = (): string[] => {
    switch (key) {
      case "computes":
      case "pia":
      case "deterministic":
      case "routine":
        return ["true", "false"];
      case "exceptions":
        return ["imprecise", "precise"];
      case "exceptional":
        return ["aborted", "violated"];
      case "resources":
        return ["world_model", ...["block", "consume", "exists"].flatMap((verb) => kinds.map((kind) => `{ ${verb}: ${kind} }`))];
      case "reads":
        return ["scene", ...predicates, ...facts];
      case "senses":
      case "shared":
        return [...predicates, ...facts];
      case "effects":
        return [...predicates, ...facts, ...[...predicates, ...facts].map((fact) => `not ${fact}`)];
      case "requires":
        return [...predicates, ...facts, ...[...predicates, ...facts].map((fact) => `exists ${fact}`)];
      default:
        return [];
    }
  };
  return words().slice(0, MOST_WORDS);
}

/** What may follow what was typed under a key: within the brackets of a predicate, the individuals of the place that is typed. */
export function completions(key: string, typed: string, all: Words): string[] {
  const open = /(?:^|[^\w])(\w+)\(([^()]*)$/.exec(typed);
  // One name may stand for predicates with different numbers of places: `in_gripper(box)`, `in_gripper(box, arm)`.
  const named = open === null ? [] : all.predicates.filter((one) => one.startsWith(`${open[1]}(`));
  if (open === null || named.length === 0) return wordsFor(key, all);
  const given = (open[2] ?? "").split(",");
  const place = given.length - 1;
  const last = (given[place] ?? "").trimStart();
  const begun = typed.slice(0, typed.length - last.length);
  const space = begun.endsWith(",") && last === "" ? " " : "";
  // Whatever is looked at may be meant: of effects only what `not` takes away.
  const any = key === "requires" || (key === "effects" && !/\b(not|delete)\b/.test(typed)) ? [] : ["?"];
  const completed = named
    .filter((one) => arity(one) > place)
    .flatMap((one) => [...offeredAt(one, place, all), ...any].map((word) => `${begun}${space}${word}${arity(one) > given.length ? ", " : ")"}`));
  return [...new Set(completed)].slice(0, MOST_WORDS);
}

function findingsList(findings: Finding[], where: boolean): HTMLElement | null {
  if (findings.length === 0) return null;
  const item = (one: Finding) =>
    h(
      "li",
      { class: one.severity === "error" ? "bad" : "warn" },
      `${one.severity}, line ${one.line}: ${where && one.path !== "" ? `${one.path}: ` : ""}${one.message}${one.help === "" ? "" : `; ${one.help}`}`,
    );
  return h("ul", { class: "plain" }, ...findings.map(item));
}

/**
 * What is in force under a key, a sentence for each who says so: nature has one key of three, and beside the resources that a state names there may be
 * the room of the world model that it takes for what it reads.
 */
export function inForce(lines: InForceLine[], key: string): string[] {
  return lines.filter((one) => one.key === key).map((one) => `In force: ${one.text} (${one.from})`);
}

const inForceLines = (lines: InForceLine[], key: string): HTMLElement[] => inForce(lines, key).map((line) => h("p", { class: "faint" }, line));

/** What the page wants of the whole. */
export interface Desk {
  /** Says it to screen readers. */
  say(text: string): void;
}

export function annotationsPage(desk: Desk): Page {
  let all: Annotations | null = null;
  let chosen: string | null = null;
  let draft: Draft = new Map();
  let checked: Proposed | null = null;
  let timer: ReturnType<typeof setTimeout> | undefined;
  /** Answers to questions before the last one do not count. */
  let question = 0;
  let loading = false;
  /** Somebody asked for it to be read while it was being read. */
  let askedAgain = false;

  const notice = h("div", { role: "alert", class: "problem", hidden: true });
  const head = h("p", {});
  const list = h("ul", { class: "plain annotated" });
  const form = h("section", { class: "annotations-form", "aria-label": "Annotations of the state" });
  const others = h("section", { "aria-label": "What else is wrong" });
  const result = h("section", { "aria-label": "What the change does", "aria-live": "polite" });
  // However many states there are, what a change does is in view.
  const said = h("div", { class: "does", role: "group", tabindex: 0, "aria-label": "What was checked" }, result, others);
  const fields = new Map<string, { findings: HTMLElement; force: HTMLElement }>();
  const save = h("button", { class: "first", disabled: true, "data-key": "save", onclick: askToSave }, "Save …");
  const undo = h("button", { disabled: true, "data-key": "undo", onclick: () => choose(chosen) }, "Undo all");
  const again = h("button", { "data-key": "again", onclick: () => void load() }, "Read the file again");

  const state = () => all?.states.find((one) => one.path === chosen) ?? null;
  const changes = () => {
    const now = state();
    return now === null ? [] : changesOf(now, draft);
  };
  const proposal = (): Proposal => ({ digest: all?.digest ?? "", state: chosen ?? "", changes: changes() });

  function complain(text: string): void {
    notice.hidden = text === "";
    fill(notice, text, text === "" ? null : h("button", { onclick: () => void load() }, "Read the file again"));
  }

  function failed(error: unknown): void {
    const text = error instanceof Error ? error.message : String(error);
    complain(error instanceof Refused && error.status === 409 ? text : `${text} `);
  }

  /** Reads the file. `sent` was written into it: what was typed since then, or for another state, stays. */
  async function load(sent?: Proposal): Promise<void> {
    if (loading) {
      askedAgain ||= sent === undefined;
      return;
    }
    loading = true;
    try {
      const read = await api.annotations();
      const stays = sent !== undefined && (sent.state !== chosen || isOther(sent, proposal()));
      all = read;
      complain(all.problem);
      fill(head, h("b", {}, all.file), ` ${all.states.length} states. What is typed is checked as by `, h("code", {}, "ratn check"), "; nothing is written before you save.");
      showList();
      const kept = all.states.some((one) => one.path === chosen) ? chosen : (all.states[0]?.path ?? null);
      if (stays && kept === chosen) goOn();
      else choose(kept);
    } catch (error) {
      failed(error);
    } finally {
      loading = false;
      if (askedAgain) {
        askedAgain = false;
        void load();
      }
    }
  }

  function showList(): void {
    const item = (one: AnnotatedState) => {
      const said = one.keys.filter((key) => key.said).map((key) => key.key);
      const force = one.in_force.map((line) => `${line.key}: ${line.text} (${line.from})`).join("\n");
      const button = h(
        "button",
        { class: "link", "data-key": `state ${one.path}`, title: force, "aria-pressed": String(one.path === chosen), onclick: () => leave(one.path) },
        one.path.slice(one.path.lastIndexOf("/") + 1),
      );
      const line = h("li", {}, button, h("span", { class: "faint" }, ` ${one.form}${said.length === 0 ? "" : ` · says ${said.join(", ")}`}${one.fixed === "" ? "" : " · not changed here"}`));
      // The policy of the page lets no attribute `style`, and this is none.
      line.style.paddingInlineStart = `${Math.min(one.depth, 20) * 18}px`;
      if (one.in_force.length > 0) {
        const rows = one.in_force.map((row) => h("li", {}, `${row.key}: ${row.text} `, h("span", { class: "faint" }, `(${row.from})`)));
        append(line, [h("details", {}, h("summary", { "aria-label": `what is in force for ${one.path}` }, "in force"), h("ul", { class: "plain" }, ...rows))]);
      }
      return line;
    };
    fill(list, ...(all?.states ?? []).map(item));
  }

  /** Chooses another state; what was typed is not lost without a question. */
  function leave(path: string): void {
    if (path === chosen) return;
    const count = changes().length;
    if (count === 0) choose(path);
    else confirm("Leave without saving?", "Leave", [h("p", {}, `What was typed for ${chosen ?? ""} is not saved.`)], true, () => choose(path));
  }

  function choose(path: string | null): void {
    chosen = path;
    checked = null;
    question += 1;
    clearTimeout(timer);
    const now = state();
    draft = now === null ? new Map() : draftOf(now);
    for (const button of list.querySelectorAll<HTMLElement>("button[data-key]")) {
      button.setAttribute("aria-pressed", String(button.dataset["key"] === `state ${path ?? ""}`));
    }
    fill(result);
    showForm();
    showFindings(all?.findings ?? []);
    update();
  }

  /** What is typed stays, and is a change of the file as it is now. */
  function goOn(): void {
    showForm();
    showFindings(all?.findings ?? []);
    edited();
  }

  function showForm(): void {
    const now = state();
    fields.clear();
    if (now === null) {
      fill(form, h("p", { class: "faint" }, "No state is chosen."));
      return;
    }
    const title = h("h2", {}, now.path, h("span", { class: "faint" }, ` ${now.form}, line ${now.line}`));
    if (now.fixed !== "") {
      const rows = now.in_force.map((row) => h("li", {}, `${row.key}: ${row.text} `, h("span", { class: "faint" }, `(${row.from})`)));
      fill(form, title, h("p", { class: "warn" }, now.fixed), h("ul", { class: "plain" }, ...rows));
      return;
    }
    const [rare, common] = [now.keys.filter((one) => RARE.includes(one.key)), now.keys.filter((one) => !RARE.includes(one.key))];
    const more = h("details", { open: rare.some((one) => one.said) }, h("summary", {}, "More annotations"), ...rare.map((one) => field(one, now)));
    fill(form, title, h("div", { id: "of-state" }), ...common.map((one) => field(one, now)), rare.length === 0 ? null : more, h("div", { class: "row saving" }, save, undo, again));
  }

  function field(one: AnnotationKey, now: AnnotatedState): HTMLElement {
    const said = draft.get(one.key) ?? { said: false, items: [] };
    const items = h("div", {});
    const findings = h("div", { id: `findings-${one.key}`, "aria-live": "polite" });
    const force = h("div", {});
    fields.set(one.key, { findings, force });
    fill(force, ...inForceLines(now.in_force, one.key));
    const words = h("datalist", { id: `words-${one.key}` });
    const offer = (typed: string) => fill(words, ...completions(one.key, typed, all ?? { kinds: [], predicates: [], entities: [], places: [] }).map((value) => h("option", { value })));
    offer("");
    const own = h("input", { type: "checkbox", checked: said.said, "data-key": `said ${one.key}` });
    const input = (item: string, index: number) => {
      const rows = item.split("\n").length;
      const more = {
        autocomplete: "off",
        spellcheck: "false",
        "aria-label": one.listed ? `${one.key}, ${index + 1}` : one.key,
        "aria-describedby": `findings-${one.key}`,
        "data-key": `${one.key} ${index}`,
        disabled: !said.said,
        onfocus: () => offer(box.value),
        oninput: () => {
          said.items[index] = box.value;
          offer(box.value);
          edited();
        },
      };
      // A text over several lines would lose its ends of lines in an input.
      const box: HTMLInputElement | HTMLTextAreaElement =
        rows > 1 ? h("textarea", { ...more, rows }, item) : h("input", { ...more, type: "text", value: item, list: `words-${one.key}` });
      const away = h(
        "button",
        {
          "aria-label": `Remove ${one.key}, ${index + 1}`,
          disabled: !said.said,
          onclick: () => {
            said.items.splice(index, 1);
            showItems();
            edited();
            add.focus();
          },
        },
        "−",
      );
      return h("div", { class: "row item" }, box, one.listed ? away : null);
    };
    const add = h(
      "button",
      {
        "data-key": `add ${one.key}`,
        "aria-label": `Add to ${one.key}`,
        onclick: () => {
          said.items.push("");
          showItems();
          items.querySelector<HTMLElement>(`[data-key="${one.key} ${said.items.length - 1}"]`)?.focus();
        },
      },
      "+",
    );
    function showItems(): void {
      if (!one.listed && said.items.length === 0) said.items.push("");
      fill(items, ...said.items.map(input));
      add.hidden = !one.listed;
      add.disabled = !said.said;
    }
    own.addEventListener("change", () => {
      said.said = own.checked;
      if (said.said) begin(one.key, said.items);
      showItems();
      edited();
    });
    draft.set(one.key, said);
    showItems();
    return h("fieldset", {}, h("legend", {}, h("label", {}, own, ` ${one.key}`)), h("p", { class: "faint" }, ABOUT[one.key] ?? ""), items, add, words, findings, force);
  }

  function showFindings(all: Finding[]): void {
    const now = state();
    const { byKey, own, others: rest } = sorted(all, chosen ?? "", now?.keys.map((one) => one.key) ?? []);
    for (const [key, { findings }] of fields) fill(findings, findingsList(byKey.get(key) ?? [], false));
    const place = form.querySelector("#of-state");
    if (place !== null) fill(place, findingsList(own, false));
    fill(others, ...(rest.length === 0 ? [] : [h("h2", {}, "Elsewhere in the file"), findingsList(rest, true)]));
  }

  function update(): void {
    const some = changes().length > 0;
    undo.disabled = !some;
    save.disabled = !maySave(changes(), checked, all?.findings ?? []);
  }

  /** Something was typed: it is checked a moment later. */
  function edited(): void {
    checked = null;
    question += 1;
    update();
    clearTimeout(timer);
    timer = setTimeout(() => void check(), DEBOUNCE_MS);
  }

  async function check(): Promise<void> {
    const [own, asked] = [question, proposal()];
    if (asked.changes.length === 0) {
      fill(result);
      showFindings(all?.findings ?? []);
      for (const [key, { force }] of fields) fill(force, ...inForceLines(state()?.in_force ?? [], key));
      return;
    }
    try {
      const answer = await api.checkAnnotations(asked);
      if (own !== question) return;
      checked = answer;
      complain("");
      showFindings(answer.findings);
      const at = fields.get(answer.key);
      if (answer.problem !== "" && at !== undefined) append(at.findings, [h("p", { class: "bad" }, answer.problem)]);
      // Of a file that does not read it is not known: what was in force stays, so that nothing jumps while somebody types.
      if (answer.in_force.length > 0) for (const [key, { force }] of fields) fill(force, ...inForceLines(answer.in_force, key));
      const gain = h("p", {}, "What it gains is simulated …");
      fill(result, ...outcome(answer), answer.problem === "" && !answer.refused ? gain : null);
      update();
      if (answer.problem !== "" || answer.refused) return;
      const gained = await api.gainOfAnnotations(asked);
      if (own === question) gain.textContent = gainText(gained);
    } catch (error) {
      if (own === question) failed(error);
    }
  }

  function outcome(answer: Proposed): Child[] {
    if (answer.problem !== "") return [h("p", { class: "bad" }, answer.problem)];
    return [
      h("h2", {}, answer.refused && !isRefused(all?.findings ?? []) ? "With this change the file would be refused" : "What would be written"),
      answer.refused && isRefused(all?.findings ?? []) ? h("p", { class: "warn" }, REFUSED) : null,
      ...lines(answer),
    ];
  }

  function lines(answer: Proposed): Child[] {
    const text = [...answer.before.map((line) => `− ${line}`), ...answer.after.map((line) => `+ ${line}`)].join("\n");
    return [h("p", { class: "faint" }, `From line ${answer.line} on:`), h("pre", { tabindex: 0 }, text)];
  }

  function askToSave(): void {
    const [asked, answer] = [proposal(), checked];
    if (answer === null) return;
    const warning = answer.refused ? h("p", { class: "warn" }, REFUSED) : null;
    confirm("Save?", "Save", [h("p", {}, `${asked.state} in ${all?.file ?? ""}:`), warning, ...lines(answer)], false, () => {
      // Of the text that is written now nothing was checked.
      checked = null;
      update();
      const saving = api.saveAnnotations(asked);
      saving.then(
        async (told) => {
          await load(asked);
          desk.say(told.said);
        },
        (error: unknown) => {
          failed(error);
          checked ??= answer;
          update();
        },
      );
    });
  }

  const element = h(
    "main",
    { id: "page", class: "annotations", tabindex: -1 },
    h("section", { "aria-label": "States of the task" }, h("h1", { class: "hidden-text" }, "Annotations"), head, list, said),
    h("div", {}, notice, form),
  );
  return { element, wide: true, begin: () => void (all === null ? load() : undefined), update: () => undefined };
}
