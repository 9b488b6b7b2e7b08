// Zones: the list of the robot's, with their switches, and the form of one that was drawn on the map.
import { byId, element, nameField } from "./dom.js";
import { freeName } from "./places.js";
import { number, words } from "./words.js";

const OFF_FOR = 600; // seconds
const FEWEST = 3; // corners

export class Zones {
  button = "tool-zone";
  words = "zone-draw";
  hint = "zone.hint";

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
    /** @type {{x: number, y: number}[]} corners of the zone that is edited */
    this.corners = [];
    this.held = -1; // the corner under the finger
    tools.add(this);
    map.overlays.push(this);
    for (const kind of ["zones", "robot", "hello"]) link.on(kind, () => this.show());
    byId("zone-kind").append(...["stop", "leave", "speed"].map((kind) => new Option(words(`zone.kind.${kind}`), kind)));
    byId("zone-kind").onchange = () => this.showForm();
    nameField("zone-name", () => this.showForm());
    byId("zone-add").onclick = () => this.add();
    byId("zone-drop").onclick = () => tools.choose(null);
  }

  enter() {
    byId("zone-name").value = freeName("zone", this.zones.map(({ name }) => name));
    this.set([]);
  }

  leave() {
    this.set([]);
  }

  get zones() {
    return this.link.newest.zones?.zones ?? [];
  }

  /** A press holds a corner of the zone that is edited; else, while there is none, edits the zone with a corner there; else adds a corner. */
  press(place) {
    if (!this.corners.length) this.edit(place);
    this.held = this.map.nearest(this.corners, place);
    if (this.held >= 0) return;
    this.held = this.corners.length;
    this.set([...this.corners, { x: place[0], y: place[1] }]);
  }

  /** Take the corners of an operator's zone that has one at this place. */
  edit(place) {
    const zone = this.zones.find(({ saved, corners }) => saved && this.map.nearest(corners.map(([x, y]) => ({ x, y })), place) >= 0);
    if (!zone) return;
    byId("zone-name").value = zone.name;
    byId("zone-kind").value = zone.kind === "speed" ? "speed" : zone.inside;
    if (zone.limit !== null) byId("zone-limit").value = zone.limit;
    this.set(zone.corners.map(([x, y]) => ({ x, y })));
  }

  drag([x, y]) {
    this.set(this.corners.with(this.held, { x, y }));
  }

  release(cancelled) {
    if (cancelled && this.held === this.corners.length - 1) this.set(this.corners.slice(0, -1));
    this.held = -1;
  }

  set(corners) {
    this.corners = corners;
    this.map.dirty = true;
    this.showForm();
  }

  showForm() {
    byId("zone").hidden = this.tools.chosen !== this;
    byId("zone-limit").parentElement.hidden = byId("zone-kind").value !== "speed";
    const missing = FEWEST - this.corners.length;
    const named = byId("zone-name").validity.valid;
    byId("zone-text").textContent = !named ? words("name.wrong") : missing > 0 ? words("zone.missing", { count: missing }) : words("zone.corners", { count: this.corners.length });
    byId("zone-add").disabled = missing > 0 || !named;
  }

  async add() {
    const kind = byId("zone-kind").value;
    const area = { kind: kind === "speed" ? "speed" : "keepout", corners: this.corners.map(({ x, y }) => [x, y]) };
    if (kind === "speed") area.limit = byId("zone-limit").valueAsNumber;
    else area.inside = kind;
    if (this.page.outcome("zone.draw", await this.link.ask({ do: "zone", order: "add", name: byId("zone-name").value, area }))) this.tools.choose(null);
  }

  draw(c, px) {
    const { map, corners } = this;
    if (corners.length) map.drawZone(c, px, corners.map(({ x, y }) => [x, y]), map.colour.accent);
    for (const { x, y } of corners) map.mark(c, px, x, y, map.colour.accent, "");
  }

  /** The list is built again when it has changed only: buttons keep the focus. */
  show() {
    const { zones, hello } = this.link.newest;
    byId("tool-zone").hidden = byId("task-zones").hidden = !zones;
    const shown = JSON.stringify([zones?.zones.map(({ name, off_until: off }) => [name, off]), zones?.inside, hello?.role]);
    if (byId("zones").dataset.shown === shown) return;
    byId("zones").dataset.shown = shown;
    byId("zones-none").hidden = zones?.zones.length > 0;
    byId("zones").replaceChildren(...(zones?.zones ?? []).map((zone) => this.row(zone, zones.inside.includes(zone.name), hello?.role === "observer")));
  }

  row({ name, kind, limit, saved, off_until: off }, inside, observer) {
    const text = [name, words(`zone.${kind}`, { limit: limit ? `${number(limit)} m/s` : "" }), ...(off === null ? [] : [words("zone.is_off")]), ...(inside ? [words("zone.inside")] : [])].join(", ");
    const ask = (order, more = {}) => async () => this.page.outcome(`zone.${order}`, await this.link.ask({ do: "zone", order, name, ...more }));
    const button = (order, more) => Object.assign(element("button", { className: "quiet", textContent: words(`zone.${order}`), ariaLabel: words(`zone.${order}.name`, { name }) }), { onclick: ask(order, more) });
    const buttons = observer ? [] : [off === null ? button("off", { seconds: OFF_FOR }) : button("on"), ...(saved ? [button("remove")] : [])];
    return element("li", {}, element("span", { textContent: text }), ...buttons);
  }
}
