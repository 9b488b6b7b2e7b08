// The time bar of a recording that is shown in place of a robot.
import { byId } from "./dom.js";
import { showTab } from "./panes.js";
import { number, words } from "./words.js";

export class ReplayBar {
  /** watch: called with the robot's name when the recording is closed. */
  constructor(link, watch) {
    this.link = link;
    this.robot = null; // which the emergency stop acts on
    this.held = false;
    link.on("robot", ({ name }) => this.opened(name));
    link.on("stops", ({ robot }) => this.showStops(robot));
    link.on("replay", (state) => this.show(state));
    byId("replay-play").onclick = () => this.send({ playing: !this.state?.playing });
    byId("replay-rate").onchange = () => this.send({ rate: Number(byId("replay-rate").value) });
    byId("replay-end").onclick = () => watch(this.robot);
    const bar = byId("replay-at");
    bar.onpointerdown = () => (this.held = true);
    bar.onchange = () => {
      this.held = false;
      this.send({ at: Number(bar.value) });
    };
  }

  send(more) {
    this.link.send({ do: "seek", ...more });
  }

  opened(name) {
    this.recording = name.includes(" ");
    byId("replay").hidden = !this.recording;
    document.body.dataset.replay = this.recording;
    if (this.recording) showTab(byId("tab-truck"));
  }

  showStops(robot) {
    this.robot = robot;
    byId("replay-stop").textContent = words("replay.stop", { robot });
  }

  show(state) {
    if (!this.recording) return;
    this.state = state;
    const bar = byId("replay-at");
    bar.max = state.length;
    if (!this.held) bar.value = state.at;
    bar.setAttribute("aria-valuetext", words("replay.time", { at: number(state.at, 0), length: number(state.length, 0) }));
    byId("replay-time").textContent = words("replay.time", { at: number(state.at, 1), length: number(state.length, 0) });
    byId("replay-fault").hidden = !state.fault && !state.growing;
    byId("replay-fault").textContent = words(state.growing ? "replay.growing" : "replay.fault", { fault: state.fault ?? "" });
    byId("replay-play").textContent = words(state.playing ? "replay.pause" : "replay.play");
  }
}
