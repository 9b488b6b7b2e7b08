// All robots at a glance: a map of where they are, and a table by which the page switches to one of them.
import { byId, element } from "./dom.js";
import { compose, outline } from "./geometry.js";
import { modeText, number, reason, words } from "./words.js";

const LOOKS = { disarmed: "", armed: "warn", driving: "good", stopping: "warn", estopped: "bad" };
const LEVELS = { low: "warn", critical: "bad", overcharged: "warn", sensor_fault: "warn" };
const COLUMNS = ["fleet.robot", "fleet.gate", "fleet.battery", "fleet.link", "fleet.place"];
const SMALLEST = 4; // metres that the map shows at least

export class FleetView {
  /** map: the map of one robot, whose grid is drawn under all of them; choose: called with a robot's name. */
  constructor(link, map, choose) {
    this.link = link;
    this.map = map;
    this.choose = choose;
    this.robots = [];
    this.canvas = byId("fleet-map");
    byId("fleet-head").append(element("tr", {}, ...COLUMNS.map((key) => element("th", { textContent: words(key), scope: "col" }))));
    byId("fleet-open").onclick = () => this.show(byId("fleet").hidden);
    this.canvas.addEventListener("pointerdown", (event) => this.press(event));
    link.on("fleet", ({ robots }) => this.take(robots));
    link.on("open", (open) => open && this.open && this.ask());
    new ResizeObserver(() => this.open && this.draw()).observe(this.canvas);
  }

  get open() {
    return !byId("fleet").hidden;
  }

  ask() {
    this.link.send({ do: "fleet", on: this.open });
  }

  show(on) {
    byId("fleet").hidden = !on;
    document.querySelector("main").hidden = on;
    byId("fleet-open").setAttribute("aria-pressed", on);
    this.ask();
    if (on) this.draw();
  }

  take(robots) {
    this.robots = robots;
    if (!this.open) return;
    const body = byId("fleet-rows");
    const names = robots.map(({ name }) => name).join();
    if (body.dataset.names !== names) {
      body.dataset.names = names;
      body.replaceChildren(...robots.map(({ name }) => {
        const button = element("button", { textContent: name });
        button.onclick = () => this.choose(name);
        return element("tr", {}, element("th", { scope: "row" }, button), ...COLUMNS.slice(1).map(() => element("td")));
      }));
    }
    robots.forEach((robot, i) => this.fill(body.children[i], robot));
    this.draw();
  }

  fill(row, robot) {
    const { alive, mode, stopping, holder, reasons, voltage, level, round_trip, pose, old } = robot;
    const gate = [modeText(mode, stopping), ...(holder ? [words("holder", { name: holder })] : []), ...reasons.slice(0, 1).map(reason)];
    const cells = [
      [gate.join(" · "), stopping ? "bad" : LOOKS[mode] ?? "bad"],
      [level ? `${voltage === null ? "–" : number(voltage, 1)} V` : "–", LEVELS[level] ?? ""],
      [alive ? words("link.value", { delay: number(1000 * round_trip, 0) }) : words("link.absent"), alive ? "" : "bad"],
      [pose ? words(old ? "fleet.was" : "fleet.at", { x: number(pose[0], 1), y: number(pose[1], 1) }) : "–", old ? "warn" : ""],
    ];
    row.classList.toggle("shown", robot.name === this.link.robot);
    cells.forEach(([text, look], i) => {
      const cell = row.children[i + 1];
      if (cell.textContent !== text) cell.textContent = text;
      cell.className = look;
    });
  }

  // The map

  /** Metres to pixels, so that every robot is to be seen. */
  fit() {
    const places = this.robots.filter(({ pose }) => pose).map(({ pose }) => pose);
    const [xs, ys] = [places.map((p) => p[0]), places.map((p) => p[1])];
    const middle = (v) => (v.length ? (Math.min(...v) + Math.max(...v)) / 2 : 0);
    const span = (v) => Math.max(SMALLEST, v.length ? Math.max(...v) - Math.min(...v) + 2 : 0);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return { x: middle(xs), y: middle(ys), scale: Math.min(width / span(xs), height / span(ys)), width, height };
  }

  draw() {
    const view = this.fit();
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(view.width * ratio), Math.round(view.height * ratio)];
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const c = this.canvas.getContext("2d");
    const colour = this.map.colour;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = colour.map;
    c.fillRect(0, 0, view.width, view.height);
    c.translate(view.width / 2, view.height / 2);
    c.scale(view.scale, -view.scale);
    c.translate(-view.x, -view.y);
    for (const image of [this.map.grid, ...this.map.tiles.values()]) if (image) this.map.drawImage(c, image);
    const { length, width: wide } = this.map.shape();
    const size = Math.max(1, 22 / (view.scale * length)); // never smaller on the screen than a finger tip
    for (const robot of this.robots) {
      if (!robot.pose) continue;
      const [front, back, backRight, frontRight] = outline(length * size, wide * size);
      c.beginPath();
      for (const corner of [front, [0.8 * length * size, 0], frontRight, backRight, back]) c.lineTo(...compose(robot.pose, [...corner, 0]).slice(0, 2));
      c.closePath();
      c.globalAlpha = robot.old ? 0.35 : 1;
      c.fillStyle = this.tint(robot);
      c.fill();
      c.strokeStyle = robot.name === this.link.robot ? colour.accent : colour.truck;
      c.lineWidth = (robot.name === this.link.robot ? 4 : 1.5) / view.scale;
      c.stroke();
      c.globalAlpha = 1;
    }
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.font = "600 13px system-ui, sans-serif";
    c.textAlign = "center";
    for (const robot of this.robots) {
      if (!robot.pose) continue;
      const [x, y] = this.toScreen(view, robot.pose);
      const half = c.measureText(robot.name).width / 2 + 5;
      c.fillStyle = colour.card;
      c.globalAlpha = 0.8;
      c.fillRect(x - half, y + 18, 2 * half, 19);
      c.globalAlpha = 1;
      c.fillStyle = colour.ink;
      c.fillText(robot.name, x, y + 32);
    }
  }

  tint({ mode }) {
    const style = getComputedStyle(document.documentElement);
    return style.getPropertyValue({ driving: "--good", armed: "--ghost", stopping: "--ghost", estopped: "--bad" }[mode] ?? "--soft").trim();
  }

  toScreen({ x, y, scale, width, height }, pose) {
    return [width / 2 + scale * (pose[0] - x), height / 2 - scale * (pose[1] - y)];
  }

  press(event) {
    const view = this.fit();
    const near = this.robots.filter(({ pose }) => pose).map((robot) => {
      const [x, y] = this.toScreen(view, robot.pose);
      return [Math.hypot(x - event.offsetX, y - event.offsetY), robot.name];
    }).sort(([a], [b]) => a - b)[0];
    if (near && near[0] < 40) this.choose(near[1]);
  }
}
