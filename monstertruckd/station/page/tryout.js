// The pane of an emulated robot: faults of its devices, and obstacles that the next press on the map puts into its world.
import { element } from "./dom.js";
import { addPane } from "./panes.js";
import { words } from "./words.js";

const FAULTS = ["none", "unplugged", "deaf", "noise"];

export class Tryout {
  button = "obstacle-add";
  hint = "tryout.hint";

  /**
   * @param {import("./socket.js").Link} link
   * @param {import("./tools.js").Tools} tools
   * @param {import("./dom.js").Page} page
   */
  constructor(link, tools, page) {
    this.link = link;
    this.tools = tools;
    this.page = page;
    const said = (name, key, fields = {}) => element(name, { textContent: words(key), ...fields });
    const add = said("button", "obstacle.add", { id: "obstacle-add" });
    add.setAttribute("aria-pressed", "false");
    this.clear = said("button", "obstacle.clear", { id: "obstacle-clear", onclick: () => this.ask({ do: "obstacle", at: null }) });
    this.faults = element("div", { id: "faults" });
    this.tab = addPane(
      "tryout",
      said("p", "tryout.help", { className: "note" }),
      said("h2", "tryout.obstacles"),
      element("div", { className: "row" }, add, this.clear),
      said("h2", "tryout.faults"),
      this.faults,
    ).tab;
    this.tab.hidden = true;
    tools.add(this);
    link.on("emulated", (state) => this.show(state));
  }

  show({ faults, obstacles = [] }) {
    const devices = Object.keys(faults);
    this.tab.hidden = !devices.length;
    this.clear.disabled = !obstacles.length;
    this.faults.replaceChildren(...devices.map((device) => {
      const choice = element("select", { id: `fault-${device}` }, ...FAULTS.map((fault) => new Option(words(`fault.${fault}`), fault)));
      choice.value = faults[device];
      choice.classList.toggle("bad", faults[device] !== "none");
      choice.onchange = () => this.ask({ do: "fault", device, fault: choice.value });
      return element("div", { className: "setting" }, element("label", { htmlFor: choice.id, textContent: device }), choice);
    }));
  }

  press(place) {
    this.at = place;
  }

  drag(place) {
    this.at = place;
  }

  release(cancelled) {
    this.tools.choose(null);
    if (!cancelled) this.ask({ do: "obstacle", at: this.at });
  }

  async ask(command) {
    if (!this.page.outcome("tab.tryout", await this.link.ask(command))) this.show(this.link.newest.emulated);
  }
}
