// Zones: the list of the robot's, with their switches, and the form of one that was drawn on the map.
import { element } from "./panels.js";
import { number, words } from "./words.js";

const byId = (id) => document.getElementById(id);
const OFF_FOR = 600; // seconds

export class Zones {
  /** page: outcome shows an answer, hint shows a key over the map. */
  constructor(link, map, page) {
    Object.assign(this, { link, map, ...page });
    for (const kind of ["zones", "robot", "hello"]) link.on(kind, () => this.show());
    map.onCorners = () => this.showForm();
    byId("zone-kind").append(...["stop", "leave", "speed"].map((kind) => new Option(words(`zone.kind.${kind}`), kind)));
    byId("zone-kind").onchange = () => this.showForm();
    byId("zone-add").onclick = () => this.add();
    byId("zone-drop").onclick = () => this.draw(false);
  }

  draw(on) {
    this.map.setCorners(on ? [] : null);
    byId("tool-zone").setAttribute("aria-pressed", on);
    this.hint(on ? "zone.hint" : null);
    this.showForm();
  }

  showForm() {
    const { corners } = this.map;
    byId("zone").hidden = !corners;
    byId("zone-limit").parentElement.hidden = byId("zone-kind").value !== "speed";
    byId("zone-text").textContent = words("zone.corners", { count: corners?.length ?? 0 });
    byId("zone-add").disabled = (corners?.length ?? 0) < 3;
  }

  async add() {
    const kind = byId("zone-kind").value;
    const area = { kind: kind === "speed" ? "speed" : "keepout", corners: this.map.corners };
    if (kind === "speed") area.limit = byId("zone-limit").valueAsNumber;
    else area.inside = kind;
    if (this.outcome("zone.draw", await this.link.ask({ do: "zone", order: "add", name: byId("zone-name").value, area }))) this.draw(false);
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
    const ask = (order, more = {}) => async () => this.outcome(`zone.${order}`, await this.link.ask({ do: "zone", order, name, ...more }));
    const button = (order, more) => Object.assign(element("button", { className: "quiet", textContent: words(`zone.${order}`), ariaLabel: words(`zone.${order}.name`, { name }) }), { onclick: ask(order, more) });
    const buttons = observer ? [] : [off === null ? button("off", { seconds: OFF_FOR }) : button("on"), ...(saved ? [button("remove")] : [])];
    return element("li", {}, element("span", { textContent: text }), ...buttons);
  }
}
