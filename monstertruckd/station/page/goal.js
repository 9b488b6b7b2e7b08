// Where the robot drives to: a goal with waypoints, or a drawn path, and what became of it.
import { byId, element } from "./dom.js";
import { degrees, number, reason, words } from "./words.js";

const AIM = 0.15; // metres of dragging from which on it is a heading
const DRAWN_STEP = 0.08; // metres between two points of a path that is drawn
const DRAWN_MOST = 400;

/**
 * Heading from one place to another, where they are far enough apart; else the one before.
 *
 * @param {number[]} place
 * @param {number[]} other
 * @param {number} before
 */
export const towards = ([x, y], [px, py], before) => (Math.hypot(px - x, py - y) > AIM ? Math.atan2(py - y, px - x) : before);

export class Goals {
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
    this.clear();
    map.overlays.push(this);
    tools.add({ button: "tool-goal", hint: "goal.hint", enter: () => this.set({ pending: null, drawn: null }), press: (place) => this.aim(place), drag: (place) => this.turn(place), release: (cancelled) => this.end(cancelled) });
    tools.add({ button: "tool-draw", hint: "map.draw.hint", enter: () => this.set({ pending: null, drawn: null, via: [] }), press: (place) => this.set({ drawn: [place] }), drag: (place) => this.lengthen(place), release: (cancelled) => this.end(cancelled || this.drawn.length < 2) });
    for (const kind of ["goal", "gate"]) link.on(kind, () => this.show());
    link.on("robot", () => this.set({ pending: null, drawn: null, via: [] }));
    byId("goal-go").onclick = () => this.go(this.pending, this.via);
    byId("goal-via").onclick = () => {
      this.set({ via: [...this.via, this.pending.slice(0, 2)], pending: null });
      tools.choose(tools.all.find(({ button }) => button === "tool-goal"));
    };
    byId("path-go").onclick = () => this.follow();
    byId("goal-drop").onclick = () => this.set({ pending: null, drawn: null, via: [] });
    for (const name of ["pause", "resume", "cancel"]) {
      byId(`goal-${name}`).onclick = async () => this.page.outcome(`goal.${name}`, await link.ask({ do: "goal_control", order: name }));
    }
  }

  clear() {
    /** @type {number[] | null} x, y, yaw of a goal that was not sent yet */
    this.pending = null;
    /** @type {number[][] | null} points of a path that was not sent yet */
    this.drawn = null;
    /** @type {number[][]} places to pass before the goal */
    this.via = [];
  }

  set(values) {
    Object.assign(this, values);
    this.map.dirty = true;
    this.show();
  }

  /** @param {number[]} place */
  aim([x, y]) {
    const { pose } = this.map;
    this.set({ pending: [x, y, pose ? Math.atan2(y - pose[1], x - pose[0]) : 0] });
  }

  turn(place) {
    const [x, y, yaw] = this.pending;
    this.set({ pending: [x, y, towards([x, y], place, yaw)] });
  }

  /** @param {number[]} place */
  lengthen([x, y]) {
    const [lx, ly] = this.drawn.at(-1);
    if (Math.hypot(x - lx, y - ly) > DRAWN_STEP && this.drawn.length < DRAWN_MOST) this.set({ drawn: [...this.drawn, [x, y]] });
  }

  end(cancelled) {
    if (cancelled) this.set({ pending: null, drawn: null });
    this.tools.choose(null);
    this.show();
  }

  /** Send the robot to a pose. */
  async go(goal, via = []) {
    const held = await this.page.stopDriving();
    if (!this.page.outcome("map.goal", await this.link.ask({ do: "goal", goal, via }))) return;
    this.set({ pending: null, via: [] });
    if (held) await this.page.letPlannersDrive();
  }

  async follow() {
    const held = await this.page.stopDriving();
    if (!this.page.outcome("map.draw", await this.link.ask({ do: "track", points: this.drawn }))) return;
    this.set({ drawn: null });
    if (held) await this.page.letPlannersDrive();
  }

  /** What the goal does now: nothing drives to it while the gate does not let the robot drive. */
  phase(phase) {
    const mode = this.link.newest.gate?.mode;
    return ["disarmed", "stopping", "estopped"].includes(mode) && phase !== "paused" ? words(`goal.held.${mode}`) : words(`phase.${phase}`);
  }

  text(state, running) {
    if (this.drawn) return words("path.drawn", { metres: number(lengthOf(this.drawn), 1) });
    if (this.pending) return words("goal.at", { x: number(this.pending[0]), y: number(this.pending[1]), yaw: degrees(this.pending[2]) });
    if (running) return words(state.remaining > 0 ? "goal.left" : "goal.state", { number: state.number, phase: this.phase(state.phase), remaining: number(state.remaining, 1) });
    if (state?.outcome === "estopped") return words("goal.estopped", { number: state.number });
    return state ? words("goal.ended", { number: state.number, text: state.text || reason(state.outcome) }) : "";
  }

  show() {
    const state = this.link.newest.goal;
    const pending = Boolean(this.pending ?? this.drawn);
    const running = state && state.phase !== "idle";
    byId("goal").hidden = !pending && !(state?.number > 0);
    byId("goal-drop").hidden = !pending;
    byId("goal-go").hidden = byId("goal-via").hidden = !this.pending;
    byId("path-go").hidden = !this.drawn;
    this.showWaypoints();
    byId("goal-pause").hidden = pending || !running || state.phase === "paused";
    byId("goal-resume").hidden = pending || state?.phase !== "paused";
    byId("goal-cancel").hidden = pending || !running;
    byId("goal-go").disabled = byId("path-go").disabled = this.link.newest.gate?.mode === "estopped";
    byId("goal-go").textContent = words(this.link.newest.gate?.mode === "disarmed" ? "goal.arm" : "goal.go");
    const text = this.text(state, running);
    if (byId("goal-text").textContent !== text) byId("goal-text").textContent = text;
  }

  showWaypoints() {
    const key = JSON.stringify(this.via);
    byId("waypoints").hidden = !this.via.length;
    if (byId("waypoints").dataset.shown === key) return;
    byId("waypoints").dataset.shown = key;
    byId("waypoints").replaceChildren(...this.via.map(([x, y], i) => {
      const drop = element("button", { className: "quiet", textContent: "×", ariaLabel: words("goal.via.drop", { number: i + 1 }) });
      drop.onclick = () => this.set({ via: this.via.filter((_, j) => j !== i) });
      return element("li", {}, element("span", { textContent: words("goal.via.row", { x: number(x), y: number(y) }) }), drop);
    }));
  }

  draw(c, px) {
    const { map } = this;
    if (map.goal) map.drawGoal(c, [map.goal.x, map.goal.y, map.goal.yaw], px, map.colour.goal);
    if (this.drawn) map.stroke(c, this.drawn, map.colour.accent, 3 * px);
    if (this.via.length) map.stroke(c, [map.pose, ...this.via, this.pending].filter(Boolean), map.colour.accent, 1.5 * px, [4 * px, 4 * px]);
    this.via.forEach(([x, y], i) => map.mark(c, px, x, y, map.colour.accent, String(i + 1)));
    if (this.pending) map.drawGoal(c, this.pending, px, map.colour.accent);
  }
}

function lengthOf(line) {
  return line.slice(1).reduce((sum, [x, y], i) => sum + Math.hypot(x - line[i][0], y - line[i][1]), 0);
}
