// The tools of the map: at most one is chosen, and takes the presses on the map.
import { byId } from "./dom.js";
import { words } from "./words.js";

/**
 * What the map asks of a tool; places are in the map frame, metres.
 *
 * @typedef {object} Tool
 * @property {string} button id of the button that chooses it
 * @property {string} [words] id of another button that chooses it, among the tasks
 * @property {string} hint key of the text over the map while it is chosen
 * @property {(place: number[]) => void} press
 * @property {(place: number[]) => void} drag
 * @property {(cancelled: boolean) => void} release
 * @property {() => void} [enter] it was chosen
 * @property {() => void} [leave] another one was chosen, or none
 */

export class Tools {
  /** @param {import("./map.js").MapView} map */
  constructor(map) {
    this.map = map;
    /** @type {Tool[]} */
    this.all = [];
    /** @type {Tool | null} */
    this.chosen = null;
  }

  /** @param {Tool} tool */
  add(tool) {
    this.all.push(tool);
    byId(tool.button).onclick = () => this.choose(this.chosen === tool ? null : tool);
    if (tool.words) byId(tool.words).onclick = () => this.choose(tool);
  }

  /** @param {Tool | null} tool null = the map is moved */
  choose(tool) {
    if (tool === this.chosen) return;
    const before = this.chosen;
    this.chosen = tool;
    before?.leave?.();
    tool?.enter?.();
    for (const each of this.all) byId(each.button).setAttribute("aria-pressed", String(each === tool));
    byId("hint").hidden = tool === null;
    if (tool) {
      byId("hint").textContent = words(tool.hint);
      byId("view").scrollIntoView({ block: "nearest" });
    }
    this.map.setTool(tool);
  }
}
