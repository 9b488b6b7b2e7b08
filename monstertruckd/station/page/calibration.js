// Calibration in the page: the wizards that fit the robot, and the one that runs, with its questions, progress and result.
import { byId, element, svg } from "./dom.js";
import { number, words } from "./words.js";

/** A value with half its interval, as people write it. */
export function shown({ value, low, high, unit }) {
  if (typeof value !== "number") return String(value);
  const half = low === null || high === null ? null : (high - low) / 2;
  const digits = half ? Math.min(Math.max(1 - Math.floor(Math.log10(half)), 0), 6) : 4;
  return [`${value.toFixed(digits)}${half ? ` ± ${half.toFixed(digits)}` : ""}`, unit].filter(Boolean).join(" ");
}

/**
 * A field for an option of a wizard, and what was given in it: nothing where it is the default.
 *
 * @param {string} id of the wizard
 * @param {{name: string, default: number | boolean | string, help: string, low: number | null, high: number | null, choices: string[], whole: boolean}} option
 */
function field(id, option) {
  const name = option.name.replaceAll("_", " ");
  const key = `option-${id}-${option.name}`;
  const flag = typeof option.default === "boolean";
  const input = option.choices.length ? element("select", { id: key }, ...option.choices.map((choice) => new Option(choice, choice)))
    : element("input", flag ? { id: key, type: "checkbox", checked: option.default } : { id: key, type: "number", step: option.whole ? "1" : "any", min: option.low ?? "", max: option.high ?? "" });
  if (!flag) input.value = option.default;
  const given = () => {
    const value = flag ? input.checked : option.choices.length ? input.value : input.valueAsNumber;
    return value === option.default || Number.isNaN(value) ? [] : [[option.name, value]];
  };
  const row = element("p", {}, element("label", { htmlFor: key, textContent: name }), input, element("small", { textContent: option.help }));
  return { row, given };
}

/** The interval of a result above that of the result before, on one scale; nothing where there is no interval. */
function intervals(row) {
  const rows = [row, row.before].filter((each) => each && each.low !== null && each.high !== null);
  if (!rows.length) return [];
  const [low, high] = [Math.min(...rows.map((each) => each.low)), Math.max(...rows.map((each) => each.high))];
  const place = (value) => 4 + (112 * (value - low)) / (high - low || 1);
  const lines = rows.flatMap((each) => {
    const [y, look] = each === row ? [6, "measured"] : [16, "before"];
    return [svg("path", { class: look, d: `M${place(each.low)} ${y}H${place(each.high)}` }), svg("circle", { class: look, cx: place(each.value), cy: y, r: 3.5 })];
  });
  const drawn = svg("svg", { class: "intervals", viewBox: "0 0 120 22", role: "img", "aria-label": words(rows.length > 1 ? "wizard.intervals" : "wizard.interval") });
  drawn.append(...lines);
  return [drawn];
}

/**
 * Measurements as points, and the fit to them as a curve, between axes with the ends of their ranges.
 *
 * @param {{name: string, x: string, y: string, points: [number, number][], curve: [number, number][] | null}} plot
 */
function plotted({ name, x, y, points, curve }) {
  const all = [...points, ...(curve ?? [])];
  const [left, right, top, bottom] = [44, 292, 22, 162];
  const range = (axis) => {
    const values = all.map((point) => point[axis]);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    return high > low ? [low, high] : [low - 0.5, low + 0.5];
  };
  const [[west, east], [south, north]] = [range(0), range(1)];
  const place = ([along, up]) => [left + ((along - west) / (east - west)) * (right - left), bottom - ((up - south) / (north - south)) * (bottom - top)];
  const drawn = svg("svg", { viewBox: "0 0 300 194", role: "img", "aria-label": name });
  const label = (text, at, anchor) => {
    const made = svg("text", { ...at, "text-anchor": anchor });
    made.textContent = text;
    return made;
  };
  const short = (value) => String(Number(value.toPrecision(3)));
  drawn.append(
    svg("path", { class: "frame", d: `M${left} ${top}V${bottom}H${right}` }),
    label(short(north), { x: left - 4, y: top + 8 }, "end"), label(short(south), { x: left - 4, y: bottom }, "end"),
    label(short(west), { x: left, y: bottom + 12 }, "start"), label(short(east), { x: right, y: bottom + 12 }, "end"),
    label(x, { x: (left + right) / 2, y: bottom + 26 }, "middle"), label(y, { x: 4, y: 12 }, "start"),
    ...points.map((point) => {
      const [cx, cy] = place(point);
      return svg("circle", { cx, cy, r: 2 });
    }),
  );
  if (curve) drawn.append(svg("path", { class: "fit", d: `M${curve.map((point) => place(point).join(" ")).join("L")}` }));
  return drawn;
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
    byId("wizards").replaceChildren(...this.wizards.map(({ id, name, rough, doc, due, options = [] }) => {
      const start = element("button", { textContent: words(rough ? "wizard.rough" : "wizard.start", { name }), className: due ? "go" : "" });
      const fields = options.map((option) => field(id, option));
      start.onclick = async () => {
        await this.order("start", { step: id, options: Object.fromEntries(fields.flatMap(({ given }) => given())) });
        byId("wizard").scrollIntoView({ block: "nearest" });
      };
      const more = fields.length ? [element("details", {}, element("summary", { textContent: words("wizard.options") }), ...fields.map(({ row }) => row))] : [];
      return element("li", {}, start, element("small", { textContent: `${due ? `${words("wizard.due")} ` : ""}${doc}` }), ...more);
    }));
  }

  answer(value) {
    this.order("answer", { value });
  }

  send() {
    const typed = Number(byId("wizard-number").value.replace(",", "."));
    if (byId("wizard-number").value.trim() && Number.isFinite(typed)) this.answer(typed);
  }

  show({ step, phase, said, progress, plot, question, measured, text }) {
    const runs = phase === "running";
    byId("wizard").hidden = phase === "idle";
    if (question && this.asked !== question.text) requestAnimationFrame(() => byId("wizard-ask").scrollIntoView({ block: "nearest" }));
    byId("wizards").hidden = runs || phase === "measured";
    byId("wizard-name").textContent = words(`wizard.${phase}`, { name: step.split(".")[0] });
    byId("wizard-said").replaceChildren(...said.map((line) => element("li", { textContent: line })));
    byId("wizard-said").scrollTop = byId("wizard-said").scrollHeight;
    const bar = byId("wizard-progress");
    bar.hidden = !progress;
    if (progress) Object.assign(bar, { max: progress.total, value: progress.done, ariaLabel: progress.name });
    byId("wizard-plot").hidden = !plot?.points.length;
    if (plot?.points.length) byId("wizard-plot").replaceChildren(element("figcaption", { textContent: plot.name }), plotted(plot));
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
      element("td", { textContent: shown(row) }, ...intervals(row)),
      element("td", { textContent: row.before === null ? "–" : shown({ ...row.before, unit: row.unit }) }),
      element("td", { textContent: row.grade ?? "–" }))));
  }
}
