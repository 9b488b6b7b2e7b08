// What explains the page: five steps at the first visit, a help text on each pane, and the map of the keys.
import { byId, element } from "./dom.js";
import { words } from "./words.js";

const STEPS = ["map", "authority", "pad", "tool-goal", "estop"]; // what each step points at
const PANES = ["drive", "tasks", "truck", "system", "events", "settings", "recordings", "plots", "tryout"];
const KEYS = ["space", "escape", "drive", "steering", "unseen", "map", "tabs", "help"];

export class Guide {
  constructor() {
    for (const pane of PANES) {
      byId(`pane-${pane}`).prepend(element("details", { className: "help" }, element("summary", { textContent: words("help") }), element("p", { className: "note", textContent: words(`help.${pane}`) })));
    }
    byId("keys-list").replaceChildren(...KEYS.flatMap((key) => [element("dt", {}, element("kbd", { textContent: words(`keys.${key}`) })), element("dd", { textContent: words(`keys.${key}.does`) })]));
    byId("keys-open").onclick = () => this.keys(byId("keys").hidden);
    byId("keys-close").onclick = () => this.keys(false);
    byId("guide-again").onclick = () => this.step(0);
    byId("guide-next").onclick = () => this.step(this.at + 1);
    byId("guide-skip").onclick = () => this.step(STEPS.length);
    window.addEventListener("keydown", (event) => {
      if (event.key === "?" && !/** @type {Element} */ (event.target).closest("input:not([type=range], [type=checkbox])")) this.keys(byId("keys").hidden);
    });
    if (localStorage.getItem("guided") === null) this.step(0);
  }

  keys(on) {
    byId("keys").hidden = !on;
    byId("keys-open").setAttribute("aria-expanded", on);
    byId(on ? "keys-close" : "keys-open").focus();
  }

  /** Show a step of the guide, or end it. */
  step(at) {
    this.at = at;
    this.keys(false);
    document.querySelector(".pointed-at")?.classList.remove("pointed-at");
    const ended = at >= STEPS.length;
    byId("guide").hidden = ended;
    if (ended) return localStorage.setItem("guided", "yes");
    const target = byId(STEPS[at]) ?? document.querySelector(`.${STEPS[at]}`);
    target.classList.add("pointed-at");
    byId("guide-text").textContent = words(`guide.${at + 1}`);
    byId("guide-count").textContent = words("guide.count", { step: at + 1, steps: STEPS.length });
    byId("guide-next").textContent = words(at === STEPS.length - 1 ? "guide.done" : "guide.next");
  }
}
