// The pane of live plots: any number of any topic, in panels that the user pins, with one cursor for them, the map and the camera.
import { byId, element } from "./dom.js";
import { Table, matching, titleOf, unitIn } from "./series.js";
import { number, words } from "./words.js";

const COLOURS = ["route", "scan", "goal", "ghost", "deformed", "frontier"];
const HEIGHT = 150;
const PAUSE = 250; // ms between two drawings of a panel
const OFFERED = 12; // numbers that are listed for one word
const MOST = 100; // numbers that the station sends one browser

/**
 * @typedef {{names: string[], units?: {name: string, factor: number}[], plot?: any, box?: HTMLElement, at?: number}} Panel
 */
export class Plots {
  /**
   * @param {import("./socket.js").Link} link
   * @param {import("./dom.js").Page} page
   */
  constructor(link, page) {
    this.link = link;
    this.page = page;
    this.table = new Table();
    this.set = 0;
    /** @type {any} the library, once the pane was shown */
    this.uPlot = null;
    this.meanings = null;
    /** @type {Promise<void> | null} */
    this.loading = null;
    this.cursor = null;
    /** @type {Panel[]} */
    this.panels = JSON.parse(localStorage.getItem("plots") ?? "[]").map((names) => ({ names }));
    link.on("open", (open) => open && this.choose());
    link.on("robot", () => this.table.clear());
    link.on("samples", ({ set, at, values }) => set === this.set && this.table.add(at, values));
    byId("tab-plots").addEventListener("click", () => this.begin());
    byId("plot-add").onclick = () => this.add(byId("plot-name").value.trim(), byId("plot-into").value);
    byId("plot-name").onkeydown = (event) => event.key === "Enter" && byId("plot-add").click();
    byId("plot-wide").onclick = () => this.widen(byId("plot-wide").getAttribute("aria-pressed") !== "true");
    byId("plot-hold").onclick = () => this.hold(byId("plot-hold").getAttribute("aria-pressed") !== "true");
    new ResizeObserver(() => this.resize()).observe(byId("plots"));
    /** @type {Set<Element>} panels that are in view: the others are not drawn */
    this.seen = new Set();
    this.sight = new IntersectionObserver((rows) => rows.forEach(({ target, isIntersecting }) => (isIntersecting ? this.seen.add(target) : this.seen.delete(target))));
    this.held = null;
    const frame = () => {
      if (!byId("pane-plots").hidden && this.uPlot) this.draw();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  get names() {
    return [...new Set(this.panels.flatMap(({ names }) => names))];
  }

  /** Ask the station for the values of what is pinned, also while the pane is not shown: the last minutes are kept. */
  async choose() {
    const { names } = this;
    this.table.choose(names);
    if (!names.length && !this.set) return;
    const answer = await this.link.ask({ do: "plot", set: ++this.set, names });
    if (this.link.open) this.page.outcome("tab.plots", answer);
  }

  /** Load what only this pane needs, once, also if it is asked for again meanwhile. */
  begin() {
    return (this.loading ??= this.load().finally(() => (this.loading = null)));
  }

  async load() {
    if (this.meanings) return;
    const [listed, { default: uPlot }] = await Promise.all([this.link.ask({ do: "numbers" }), import("./uplot.js")]);
    if (!this.page.outcome("tab.plots", listed)) return;
    if (!document.querySelector("link[href='/page/uplot.css']")) document.head.append(element("link", { rel: "stylesheet", href: "/page/uplot.css" }));
    this.meanings = listed.value.numbers;
    this.uPlot = uPlot;
    byId("plot-names").replaceChildren(...Object.entries(this.meanings).map(([name, meaning]) => new Option(meaning, name)));
    this.show();
  }

  async add(name, into) {
    await this.begin();
    if (!this.meanings) return;
    const [found, ...others] = matching(this.meanings, name);
    this.offer(others.length ? [found, ...others] : [], into);
    byId("plot-note").textContent = found ? (others.length ? words("plots.several", { name }) : "") : words("plots.unknown", { name });
    if (!found || others.length || this.names.length >= MOST) return;
    byId("plot-name").value = "";
    const panel = this.panels[into];
    if (!panel) this.panels.push({ names: [found] });
    else if (!panel.names.includes(found)) panel.names.push(found);
    this.changed();
  }

  /** Offer numbers, each with its meaning, to be plotted by a press. */
  offer(names, into) {
    byId("plot-found").replaceChildren(...names.slice(0, OFFERED).map((name) => {
      const choose = element("button", { textContent: words("plots.add"), ariaLabel: words("plots.add.name", { name: titleOf(name) }) });
      choose.onclick = () => this.add(name, into);
      return element("li", {}, element("span", {}, titleOf(name), element("small", { textContent: this.meanings[name] })), choose);
    }));
  }

  drop(panel, name) {
    panel.names = panel.names.filter((each) => each !== name);
    if (!panel.names.length) this.panels = this.panels.filter((each) => each !== panel);
    this.changed();
  }

  /** Move a panel one place up. */
  raise(panel) {
    const i = this.panels.indexOf(panel);
    if (i > 0) this.panels.splice(i - 1, 2, panel, this.panels[i - 1]);
    this.changed();
  }

  changed() {
    localStorage.setItem("plots", JSON.stringify(this.panels.map(({ names }) => names)));
    this.choose();
    this.show();
  }

  /** Stop the time axis, or let it run on. */
  hold(on) {
    this.held = on ? this.table.times.at(-1) ?? null : null;
    byId("plot-hold").setAttribute("aria-pressed", on);
    for (const panel of this.panels) panel.at = 0;
  }

  /** Give the plots half of a wide screen. */
  widen(on) {
    byId("plot-wide").setAttribute("aria-pressed", on);
    document.body.dataset.wide = on;
  }

  /** Build all panels anew. */
  show() {
    this.sight.disconnect();
    this.seen.clear();
    for (const panel of this.panels) panel.plot?.destroy();
    byId("plots").replaceChildren(...this.panels.map((panel, i) => this.build(panel, i)));
    for (const { box } of this.panels) this.sight.observe(box);
    const into = byId("plot-into").value;
    byId("plot-into").replaceChildren(new Option(words("plots.new"), ""), ...this.panels.map((_, i) => new Option(words("plots.into", { number: i + 1 }), String(i))));
    byId("plot-into").value = this.panels[into] ? into : "";
    byId("plots-none").hidden = this.panels.length > 0;
  }

  build(panel, i) {
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    panel.units = panel.names.map((name) => unitIn(this.meanings[name] ?? ""));
    const legend = element("ul", { className: "legend" }, ...panel.names.map((name, j) => {
      const drop = element("button", { className: "quiet", textContent: "×", ariaLabel: words("plots.drop", { name: titleOf(name) }) });
      drop.onclick = () => this.drop(panel, name);
      const swatch = element("i", {});
      swatch.style.background = colour(COLOURS[j % COLOURS.length]);
      return element("li", { title: this.meanings[name] ?? "" }, swatch, element("span", { textContent: titleOf(name) }), element("output"), drop);
    }));
    const up = element("button", { className: "quiet", textContent: "↑", hidden: i === 0, ariaLabel: words("plots.up", { number: i + 1 }) });
    up.onclick = () => this.raise(panel);
    const canvas = element("div", { className: "curve" });
    panel.box = element("section", { className: "plot", ariaLabel: words("plots.number", { number: i + 1 }) }, element("div", { className: "head" }, legend, up), canvas);
    const units = [...new Set(panel.units.map(({ name }) => name))];
    const text = { stroke: colour("soft"), grid: { stroke: colour("map-grid"), width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
    panel.plot = new this.uPlot({
      width: 300,
      height: HEIGHT,
      legend: { show: false },
      cursor: { sync: { key: "plots" }, drag: { x: false, y: false }, points: { size: 5 } },
      scales: { x: { time: false } },
      series: [{}, ...panel.names.map((_, j) => ({ stroke: colour(COLOURS[j % COLOURS.length]), width: 1.5, scale: `y ${panel.units[j].name}`, spanGaps: true, points: { show: false } }))],
      axes: [
        { ...text, size: 26, values: (_plot, ticks) => ticks.map((tick) => `${Math.round(tick - this.until())} s`) },
        ...units.map((unit, j) => ({ ...text, scale: `y ${unit}`, side: j % 2 ? 1 : 3, size: 44, label: unit || undefined, labelSize: unit ? 14 : 0, labelFont: "11px system-ui, sans-serif", grid: { ...text.grid, show: j === 0 } })),
      ],
      hooks: { setCursor: [(plot) => this.point(plot)] },
    }, [[], ...panel.names.map(() => [])], canvas);
    panel.at = 0;
    return panel.box;
  }

  resize() {
    for (const { plot, box } of this.panels) if (plot && box.clientWidth) plot.setSize({ width: box.clientWidth - 2, height: HEIGHT });
  }

  /** End of the time axis. */
  until() {
    return this.held ?? this.table.times.at(-1) ?? 0;
  }

  /** The cursor is over a plot, or left it: map and camera show that time. */
  point(plot) {
    const at = plot.cursor.idx == null ? null : plot.data[0][plot.cursor.idx] ?? null;
    if (at === this.cursor) return;
    this.cursor = at;
    this.page.pointed(at);
    for (const panel of this.panels) this.label(panel);
  }

  /** Draw the panel whose turn it is, if one is due: one in each picture of the screen. */
  draw() {
    const now = performance.now();
    const panel = this.panels.find((each) => this.seen.has(each.box) && now - each.at > PAUSE);
    if (!panel) return;
    panel.at = now;
    const until = this.until();
    const from = until - Number(byId("plot-window").value);
    const data = this.table.between(from, until, panel.names, panel.units.map(({ factor }) => factor));
    panel.plot.batch(() => {
      panel.plot.setData(data);
      panel.plot.setScale("x", { min: from, max: until });
    });
    this.label(panel);
  }

  /** @param {Panel} panel */
  label({ names, units, box }) {
    const at = this.cursor ?? this.until();
    const outputs = box?.querySelectorAll("output") ?? [];
    names.forEach((name, i) => {
      const value = this.table.value(name, at);
      const text = value === null ? "–" : `${number(value * units[i].factor, 3)}${units[i].name && ` ${units[i].name}`}`;
      if (outputs[i] && outputs[i].textContent !== text) outputs[i].textContent = text;
    });
  }
}
