// Questions before something is done that is more than looking.

import { type Child, h } from "./dom";

/** Asks, and does it once the user has said yes. */
export function confirm(title: string, yesText: string, content: Child[], danger: boolean, act: () => void): void {
  const yes = h("button", { class: danger ? "danger" : "first", value: "yes" }, yesText);
  const dialog = h(
    "dialog",
    { "aria-labelledby": "question" },
    h("h2", { id: "question" }, title),
    ...content,
    h("div", { class: "row" }, yes, h("button", { value: "no", onclick: () => dialog.close() }, "Cancel")),
  );
  yes.addEventListener("click", () => {
    dialog.close();
    act();
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
