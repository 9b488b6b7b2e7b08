// Missions drawn on the map: waypoints that are placed, turned, dragged and removed, then driven in their order, watched, or kept as a file.
import { byId, element, nameField } from "./dom.js";
import { towards } from "./goal.js";
import { give } from "./mapfile.js";
import { degrees, number, words } from "./words.js";

const MOST = 100; // waypoints

/**
 * A waypoint: a pose in map, or a point of interest there.
 *
 * @typedef {{x: number, y: number, yaw: number, point?: string}} Stop
 */

/**
 * The mission file of some waypoints.
 *
 * @param {{name: string, stops: Stop[], rounds: number, home: boolean}} mission
 */
export function missionText({ name, stops, rounds, home }) {
  const shown = (value) => String(Number(value.toFixed(3)));
  const lines = stops.map(({ x, y, yaw, point }) => (point ? `{ do: goto_point, point: ${JSON.stringify(point)} }` : `{ do: goto, x: ${shown(x)}, y: ${shown(y)}, yaw: ${shown(yaw)} }`));
  const steps = rounds > 1 ? ["  - do: repeat", `    times: ${rounds}`, "    steps:", ...lines.map((line) => `      - ${line}`)] : lines.map((line) => `  - ${line}`);
  return ["version: 2", `name: ${JSON.stringify(name)}`, "steps:", ...steps, ...(home ? ["  - { do: return }"] : []), ""].join("\n");
}

/** Which waypoint a mission that was drawn drives to now; -1 = none. The numbers of its steps are "2", or "1.2" in a loop. */
export function stopOf({ running, node }, stops) {
  const last = Number(String(node ?? "").split(".").at(-1));
  return running && last >= 1 && last <= stops.length ? last - 1 : -1;
}

export class MissionTool {
  button = "tool-mission";
  words = "mission-draw";
  hint = "mission.hint";

  /**
   * @param {import("./socket.js").Link} link
   * @param {import("./map.js").MapView} map
   * @param {import("./tools.js").Tools} tools
   * @param {import("./dom.js").Page} page
   */
  constructor(link, map, tools, page) {
    this.link = link;
    this.map = map;
    this.tools = tools;
    this.page = page;
    /** @type {Stop[]} */
    this.stops = [];
    this.held = -1; // the waypoint under the finger
    this.moving = false;
    tools.add(this);
    map.overlays.push(this);
    link.on("facts", ({ goals }) => (byId("tool-mission").hidden = !goals));
    link.on("robot", () => this.set([]));
    link.on("mission", () => (map.dirty = true));
    byId("mission-run").onclick = () => this.run();
    byId("mission-keep").onclick = () => this.keep();
    byId("mission-drop").onclick = () => {
      this.set([]);
      tools.choose(null);
    };
    nameField("mission-name", () => this.show());
  }

  enter() {
    this.show();
  }

  leave() {
    this.show();
  }

  press(place) {
    this.held = this.map.nearest(this.stops, place);
    this.moving = this.held >= 0;
    if (this.moving || this.stops.length >= MOST) return;
    const points = this.link.newest.points?.points ?? [];
    const near = points[this.map.nearest(points, place)];
    const [x, y] = near ? [near.x, near.y] : place;
    const before = this.stops.at(-1) ?? this.map.pose;
    const from = before && (Array.isArray(before) ? before : [before.x, before.y]);
    const yaw = near ? near.yaw : from ? Math.atan2(y - from[1], x - from[0]) : 0;
    this.held = this.stops.length;
    this.set([...this.stops, near ? { x, y, yaw, point: near.name } : { x, y, yaw }]);
  }

  drag([x, y]) {
    const stop = this.stops[this.held];
    if (!stop) return;
    const changed = this.moving ? { x, y, yaw: stop.yaw } : { ...stop, yaw: stop.point ? stop.yaw : towards([stop.x, stop.y], [x, y], stop.yaw) };
    this.set(this.stops.with(this.held, changed));
  }

  release(cancelled) {
    if (cancelled && !this.moving) this.set(this.stops.slice(0, -1));
    this.held = -1;
  }

  /** @param {Stop[]} stops */
  set(stops) {
    this.stops = stops;
    this.map.dirty = true;
    this.show();
  }

  get mission() {
    return { name: byId("mission-name").value, stops: this.stops, rounds: byId("mission-rounds").valueAsNumber || 1, home: byId("mission-home").checked };
  }

  async run() {
    const answer = await this.page.begin("task.mission", { do: "mission", order: "start", text: missionText(this.mission) });
    if (answer.ok) this.tools.choose(null);
  }

  /** Give the mission to the browser as a file, which the command line runs, too. */
  keep() {
    const { mission } = this;
    give(`${mission.name}.yaml`, missionText(mission));
  }

  show() {
    byId("mission").hidden = this.tools.chosen !== this;
    const named = byId("mission-name").validity.valid;
    const ready = this.stops.length > 0 && named;
    byId("mission-text").textContent = named ? words(ready ? "mission.stops" : "mission.first", { count: this.stops.length }) : words("name.wrong");
    byId("mission-run").disabled = byId("mission-keep").disabled = !ready;
    const key = JSON.stringify(this.stops);
    if (byId("mission-stops").dataset.shown === key) return;
    byId("mission-stops").dataset.shown = key;
    byId("mission-stops").replaceChildren(...this.stops.map(({ x, y, yaw, point }, i) => {
      const drop = element("button", { className: "quiet", textContent: "×", ariaLabel: words("goal.via.drop", { number: i + 1 }) });
      drop.onclick = () => this.set(this.stops.filter((_, j) => j !== i));
      const text = point ?? words("mission.stop", { x: number(x), y: number(y), yaw: degrees(yaw) });
      return element("li", {}, element("span", { textContent: text }), drop);
    }));
  }

  draw(c, px) {
    const { map, stops } = this;
    const present = stopOf(this.link.newest.mission ?? {}, stops);
    map.stroke(c, [map.pose, ...stops.map(({ x, y }) => [x, y])].filter(Boolean), map.colour.accent, 1.5 * px, [4 * px, 4 * px]);
    stops.forEach(({ x, y, yaw }, i) => {
      map.drawGoal(c, [x, y, yaw], px, map.colour[i === present ? "goal" : "accent"]);
      map.mark(c, px, x, y, map.colour[i === present ? "goal" : "accent"], String(i + 1));
    });
  }
}
