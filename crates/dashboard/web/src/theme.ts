// Light and dark, and the colours of the style sheet for what is drawn.

const KEY = "ratn-theme";
const ORDER = ["auto", "light", "dark"] as const;
export type Theme = (typeof ORDER)[number];

export function theme(): Theme {
  const kept = localStorage.getItem(KEY);
  return ORDER.find((one) => one === kept) ?? "auto";
}

export function applyTheme(): void {
  const now = theme();
  if (now === "auto") delete document.documentElement.dataset["theme"];
  else document.documentElement.dataset["theme"] = now;
  colours.clear();
}

export function nextTheme(): Theme {
  const next = ORDER[(ORDER.indexOf(theme()) + 1) % ORDER.length] ?? "auto";
  localStorage.setItem(KEY, next);
  applyTheme();
  return next;
}

const colours = new Map<string, string>();
let probe: HTMLElement | null = null;

/** A colour of the style sheet, as it is now. */
export function colour(name: string): string {
  let found = colours.get(name);
  if (found === undefined) {
    if (probe === null) {
      probe = document.createElement("span");
      probe.hidden = true;
      document.body.append(probe);
    }
    probe.style.color = `var(--${name})`;
    found = getComputedStyle(probe).color;
    colours.set(name, found);
  }
  return found;
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => colours.clear());
