// Elements, made so that a name that a user chose is always text.

export type Child = Node | string | number | null | undefined | false;
type Attributes = Record<string, string | number | boolean | null | undefined | ((event: Event) => void)>;

/** An element with attributes, listeners (`onclick: …`) and children. There is no way to say markup. */
export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, String(value));
  }
  append(element, children);
  return element;
}

export function append(element: Element, children: Child[]): void {
  for (const child of children) {
    if (child === null || child === undefined || child === false) continue;
    element.append(typeof child === "number" ? String(child) : child);
  }
}

/** What one types into. */
function isTyped(element: Element): element is HTMLInputElement | HTMLTextAreaElement {
  return element instanceof HTMLTextAreaElement || (element instanceof HTMLInputElement && element.type === "text");
}

/** Replaces the children. Where an element of the same `data-key` has the focus it keeps it, with the place that is typed at. */
export function fill(element: Element, ...children: Child[]): void {
  const active = document.activeElement;
  const key = active instanceof HTMLElement && element.contains(active) ? active.dataset["key"] : undefined;
  const place = active !== null && isTyped(active) ? ([active.selectionStart, active.selectionEnd] as const) : null;
  const { scrollTop, scrollLeft } = element;
  element.replaceChildren();
  append(element, children);
  [element.scrollTop, element.scrollLeft] = [scrollTop, scrollLeft];
  if (key === undefined) return;
  const same = [...element.querySelectorAll<HTMLElement>("[data-key]")].find((one) => one.dataset["key"] === key);
  if (same === undefined) return;
  same.focus({ preventScroll: true });
  if (place !== null && isTyped(same)) same.setSelectionRange(...place);
}

/** A drawn sample for a legend: a box of a colour or a line. */
export function sample(kind: string, line: boolean): SVGSVGElement {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("viewBox", "0 0 22 10");
  svg.setAttribute("aria-hidden", "true");
  const shape = document.createElementNS(space, line ? "path" : "rect");
  if (line) {
    shape.setAttribute("d", "M0 5H22");
    shape.setAttribute("stroke-width", "3");
    shape.setAttribute("class", `line-${kind}`);
    const dashes = DASHES[kind];
    if (dashes !== undefined && dashes.length > 0) shape.setAttribute("stroke-dasharray", dashes.join(" "));
  } else {
    for (const [name, value] of [["width", "22"], ["height", "10"], ["rx", "2"], ["class", `fill-${kind}`]] as const) {
      shape.setAttribute(name, value);
    }
  }
  svg.append(shape);
  return svg;
}

/** Kinds of edges differ in more than their colour. */
export const DASHES: Record<string, number[]> = { data: [], world: [8, 3], resource: [2, 3], condition: [10, 3, 2, 3] };

const SECONDS = [0, 1, 2].map(
  (digits) => new Intl.NumberFormat(navigator.language, { minimumFractionDigits: digits, maximumFractionDigits: digits }),
);
const WHOLE = new Intl.NumberFormat(navigator.language, { maximumFractionDigits: 0 });

/** A moment or a length of the robot's time, as the reader's language writes numbers. */
export function seconds(value: number, digits: 0 | 1 | 2 = 1): string {
  return `${SECONDS[digits]?.format(value) ?? value}\u00a0s`;
}

export function count(value: number): string {
  return WHOLE.format(value);
}

export function percent(value: number): string {
  return `${SECONDS[1]?.format(value) ?? ""}\u00a0%`;
}

export function bytes(value: number): string {
  return `${SECONDS[1]?.format(value / (1 << 20)) ?? ""}\u00a0MiB`;
}

/** A table with a caption; `numbers` are the columns that stand at the right. */
export function table(caption: string, head: string[], rows: Child[][], numbers: number[] = []): HTMLElement {
  const cell = (index: number) => (numbers.includes(index) ? { class: "number" } : {});
  if (rows.length === 0) return h("p", { class: "nothing" }, h("b", {}, caption), " none");
  // A table that is wider than the page is scrolled, by keys, too.
  return h(
    "div",
    { class: "scroll", tabindex: 0, role: "region", "aria-label": caption, "data-key": `table ${caption}` },
    h(
      "table",
      {},
      h("caption", {}, caption),
      h("thead", {}, h("tr", {}, ...head.map((text, index) => h("th", { scope: "col", ...cell(index) }, text)))),
      h("tbody", {}, ...rows.map((row) => h("tr", {}, ...row.map((value, index) => h("td", cell(index), value))))),
    ),
  );
}
