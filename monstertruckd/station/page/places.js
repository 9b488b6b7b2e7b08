// Points of interest: the list of the robot's, and the tool that marks, moves, names, removes and drives to them on the map.
import { byId, element, nameField } from "./dom.js";
import { compose } from "./geometry.js";
import { towards } from "./goal.js";
import { degrees, number, words } from "./words.js";

const BEFORE_TAG = 0.7; // metres before a tag at which the robot looks at it, as the command line has it

/** Where the robot goes to for a point: a marked place itself, or before a tag that it faces. */
export function poseAt({ kind, x, y, yaw }) {
  if (kind !== "tag") return [x, y, yaw];
  const [px, py] = compose([x, y, yaw], [BEFORE_TAG, 0, 0]);
  return [px, py, yaw + Math.PI > Math.PI ? yaw - Math.PI : yaw + Math.PI];
}

/** The first of place-1, place-2 ... that is free. */
export function freeName(stem, taken) {
  for (let i = 1; ; i++) if (!taken.includes(`${stem}-${i}`)) return `${stem}-${i}`;
}

export class Places {
  button = "tool-point";
  words = "point-draw";
  hint = "point.hint";

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
    /** The point that is edited: its values, and the name `old` that the robot has it by, if it has; @type {any} */
    this.edited = null;
    this.moving = false;
    tools.add(this);
    map.overlays.push(this);
    for (const kind of ["points", "robot", "hello"]) link.on(kind, () => this.show());
    link.on("robot", () => this.edit(null));
    byId("point-save").onclick = () => this.save();
    byId("point-go").onclick = () => this.page.go(poseAt(this.edited));
    byId("point-remove").onclick = () => this.remove(this.edited.old);
    byId("point-drop").onclick = () => this.edit(null);
    nameField("point-name", () => this.showForm());
    byId("point-here").onclick = () => this.ask({ do: "point", order: "mark", name: freeName("place", this.names) });
  }

  get points() {
    return this.link.newest.points?.points ?? [];
  }

  get names() {
    return this.points.map(({ name }) => name);
  }

  leave() {
    this.edit(null);
  }

  press(place) {
    const rows = this.edited ? [this.edited, ...this.points] : this.points;
    const found = rows[this.map.nearest(rows, place)];
    this.moving = Boolean(found);
    if (found && found === this.edited) return;
    const [x, y] = place;
    if (found) this.edit({ ...found, old: found.name });
    else if (this.edited && !this.edited.old) this.edit({ ...this.edited, x, y, name: byId("point-name").value }); // not kept yet: it goes there
    else this.edit({ name: freeName("place", this.names), old: null, kind: "mark", x, y, yaw: 0 });
  }

  drag([x, y]) {
    const { edited } = this;
    if (!edited || edited.kind === "tag") return; // a tag is where the camera sees it
    if (this.moving) Object.assign(edited, { x, y });
    else edited.yaw = towards([edited.x, edited.y], [x, y], edited.yaw);
    this.map.dirty = true;
    this.showForm();
  }

  release(cancelled) {
    if (cancelled) this.edit(null);
  }

  edit(point) {
    this.edited = point;
    if (point) byId("point-name").value = point.name;
    this.map.dirty = true;
    this.showForm();
  }

  showForm() {
    const { edited } = this;
    byId("point").hidden = !edited;
    if (!edited) return;
    const tag = edited.kind === "tag";
    byId("point-text").textContent = words(tag ? "point.tag" : "point.at", { x: number(edited.x), y: number(edited.y), yaw: degrees(edited.yaw) });
    byId("point-name").disabled = tag;
    const name = byId("point-name").value;
    byId("point-save").hidden = tag;
    byId("point-save").disabled = !byId("point-name").validity.valid || (name !== edited.old && this.names.includes(name));
    byId("point-go").hidden = byId("point-remove").hidden = !edited.old;
  }

  async ask(command) {
    return this.page.outcome(`point.${command.order}`, await this.link.ask(command));
  }

  /** Keep the edited point; one with another name than before is marked anew, then the old one is removed. */
  async save() {
    const { old, x, y, yaw } = this.edited;
    const name = byId("point-name").value;
    if (!(await this.ask({ do: "point", order: "mark", name, place: [x, y], yaw }))) return;
    if (old && old !== name && !(await this.ask({ do: "point", order: "remove", name: old }))) return;
    this.edit(null);
  }

  async remove(name) {
    if (await this.ask({ do: "point", order: "remove", name })) this.edit(null);
  }

  /** The list is built again when it has changed only: buttons keep the focus. */
  show() {
    const { points, hello } = this.link.newest;
    byId("tool-point").hidden = byId("task-points").hidden = !points;
    const observer = hello?.role === "observer";
    const shown = JSON.stringify([this.names, observer]);
    if (byId("points").dataset.shown === shown) return;
    byId("points").dataset.shown = shown;
    byId("points-none").hidden = this.names.length > 0;
    byId("point-here").hidden = observer;
    byId("points").replaceChildren(...this.names.map((name) => {
      const button = (what, press) => Object.assign(element("button", { className: "quiet", textContent: words(`point.${what}`), ariaLabel: words(`point.${what}.name`, { name }) }), { onclick: press });
      const buttons = observer ? [] : [button("go", () => this.page.go(poseAt(this.points.find((point) => point.name === name)))), button("remove", () => this.remove(name))];
      return element("li", {}, element("span", { textContent: name }), ...buttons);
    }));
  }

  draw(c, px) {
    const { map, edited } = this;
    if (map.layers.points) for (const { x, y, name } of this.points) if (name !== edited?.old) map.mark(c, px, x, y, map.colour.point, name);
    if (!edited) return;
    map.drawGoal(c, [edited.x, edited.y, edited.yaw], px, map.colour.accent);
    map.label(c, px, edited.x, edited.y, byId("point-name").value);
  }
}
