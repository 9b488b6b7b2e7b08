// The pane of an emulated robot: faults of its devices, and obstacles that the next press on the map puts into its world.
import { element } from "./panels.js";
import { words } from "./words.js";

const byId = (id) => document.getElementById(id);
const FAULTS = ["none", "unplugged", "deaf", "noise"];

export class Tryout {
  /** page: outcome shows an answer; aim(true) lets the next press on the map choose a place. */
  constructor(link, page) {
    Object.assign(this, { link, ...page });
    this.placing = false;
    link.on("emulated", (state) => this.show(state));
    byId("obstacle-add").onclick = () => this.place(!this.placing);
    byId("obstacle-clear").onclick = () => this.ask({ do: "obstacle", at: null });
  }

  show({ faults, obstacles = [] }) {
    const devices = Object.keys(faults);
    byId("tab-tryout").hidden = !devices.length;
    byId("obstacle-clear").disabled = !obstacles.length;
    byId("faults").replaceChildren(...devices.map((device) => {
      const choice = element("select", { id: `fault-${device}` }, ...FAULTS.map((fault) => new Option(words(`fault.${fault}`), fault)));
      choice.value = faults[device];
      choice.classList.toggle("bad", faults[device] !== "none");
      choice.onchange = () => this.ask({ do: "fault", device, fault: choice.value });
      return element("div", { className: "setting" }, element("label", { htmlFor: choice.id, textContent: device }), choice);
    }));
  }

  place(on) {
    this.placing = on;
    byId("obstacle-add").setAttribute("aria-pressed", on);
    this.aim(on);
  }

  /** A place on the map was pressed; whether it was meant for an obstacle. */
  take(pose) {
    if (!this.placing) return false;
    this.place(false);
    if (pose) this.ask({ do: "obstacle", at: pose.slice(0, 2) });
    return true;
  }

  async ask(command) {
    if (!this.outcome("tab.tryout", await this.link.ask(command))) this.show(this.link.newest.emulated);
  }
}
