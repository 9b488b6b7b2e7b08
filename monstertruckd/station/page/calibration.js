// Calibration in the page: the wizards that fit the robot, and the one that runs, with its questions, progress and result.
import { byId, element } from "./dom.js";
import { number, words } from "./words.js";

/** A value with half its interval, as people write it. */
export function shown({ value, low, high, unit }) {
  if (typeof value !== "number") return String(value);
  const half = low === null || high === null ? null : (high - low) / 2;
  const digits = half ? Math.min(Math.max(1 - Math.floor(Math.log10(half)), 0), 6) : 4;
  return [`${value.toFixed(digits)}${half ? ` ± ${half.toFixed(digits)}` : ""}`, unit].filter(Boolean).join(" ");
}

export class Calibration {
  /**
   * @param {import("./socket.js").Link} link
   * @param {import("./dom.js").Page} page
   */
  constructor(link, page) {
    this.link = link;
    this.page = page;
    this.wizards = null;
    this.asked = "";
    link.on("calibrating", (state) => this.show(state));
    link.on("robot", () => this.clear());
    byId("wizards-list").onclick = () => this.list();
    byId("wizard-yes").onclick = () => this.answer(true);
    byId("wizard-no").onclick = () => this.answer(false);
    byId("wizard-send").onclick = () => this.send();
    byId("wizard-number").onkeydown = (event) => event.key === "Enter" && this.send();
    byId("wizard-accept").onclick = () => this.order("accept");
    byId("wizard-discard").onclick = () => this.order("discard");
  }

  clear() {
    this.wizards = null;
    byId("wizards").replaceChildren();
    byId("wizard").hidden = true;
  }

  async order(order, more = {}) {
    const answer = await this.link.ask({ do: "calibrate", order, ...more });
    this.page.outcome("calibration", answer);
    return answer;
  }

  async list() {
    const answer = await this.order("list");
    if (!answer.ok) return;
    this.wizards = answer.value.wizards;
    byId("wizards").replaceChildren(...this.wizards.map(({ id, name, rough, doc, due }) => {
      const start = element("button", { textContent: words(rough ? "wizard.rough" : "wizard.start", { name }), className: due ? "go" : "" });
      start.onclick = () => this.order("start", { step: id });
      return element("li", {}, start, element("small", { textContent: `${due ? `${words("wizard.due")} ` : ""}${doc}` }));
    }));
  }

  answer(value) {
    this.order("answer", { value });
  }

  send() {
    const typed = Number(byId("wizard-number").value.replace(",", "."));
    if (byId("wizard-number").value.trim() && Number.isFinite(typed)) this.answer(typed);
  }

  show({ step, phase, said, progress, question, measured, text }) {
    const runs = phase === "running";
    byId("wizard").hidden = phase === "idle";
    byId("wizards").hidden = runs || phase === "measured";
    byId("wizard-name").textContent = words(`wizard.${phase}`, { name: step.split(".")[0] });
    byId("wizard-said").replaceChildren(...said.map((line) => element("li", { textContent: line })));
    byId("wizard-said").scrollTop = byId("wizard-said").scrollHeight;
    const bar = byId("wizard-progress");
    bar.hidden = !progress;
    if (progress) Object.assign(bar, { max: progress.total, value: progress.done, ariaLabel: progress.name });
    byId("wizard-ask").hidden = !question;
    if (question) this.ask(question);
    byId("wizard-result").hidden = !measured;
    if (measured) this.result(measured);
    byId("wizard-accept").hidden = phase !== "measured";
    byId("wizard-discard").hidden = !runs && phase !== "measured";
    byId("wizard-discard").textContent = words(runs ? "wizard.cancel" : "wizard.discard");
    byId("wizard-text").textContent = phase === "saved" ? words("wizard.file", { file: text }) : text;
  }

  ask({ kind, name, text, low, high }) {
    byId("wizard-question").textContent = text;
    for (const id of ["wizard-number", "wizard-send"]) byId(id).hidden = kind !== "number";
    for (const id of ["wizard-yes", "wizard-no"]) byId(id).hidden = kind !== "confirm";
    if (this.asked === text) return;
    this.asked = text;
    byId("wizard-number").value = "";
    byId("wizard-number").ariaLabel = `${name}, ${low} – ${high}`;
    byId("wizard-number").placeholder = kind === "number" ? `${number(low, 3)} – ${number(high, 3)}` : "";
  }

  result({ rows, text }) {
    byId("wizard-measured").textContent = text;
    byId("wizard-rows").replaceChildren(...rows.map((row) => element("tr", {},
      element("td", {}, row.name.replaceAll("_", " "), element("small", { textContent: row.meaning })),
      element("td", { textContent: shown(row) }),
      element("td", { textContent: row.before === null ? "–" : shown({ value: row.before, low: null, high: null, unit: row.unit }) }),
      element("td", { textContent: row.grade ?? "–" }))));
  }
}
