import { CameraView } from "./camera.js";
import { Calibration } from "./calibration.js";
import { Drive } from "./drive.js";
import { FleetView } from "./fleet.js";
import { MapView } from "./map.js";
import { commandLine } from "./commandline.js";
import { element, Panels } from "./panels.js";
import { Plots } from "./plots.js";
import { Guide } from "./guide.js";
import { ReplayBar } from "./replay.js";
import { Link } from "./socket.js";
import { Tryout } from "./tryout.js";
import { Work } from "./work.js";
import { Zones } from "./zones.js";
import { degrees, loadWords, number, reason, words } from "./words.js";

const byId = (id) => document.getElementById(id);

const theme = localStorage.getItem("theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
document.documentElement.dataset.theme = theme;

const link = new Link();

// The emergency stop works before anything else does: by its button, and by the space bar wherever the focus is.
function estop() {
  order("estop");
}
byId("estop").addEventListener("pointerdown", estop);
byId("estop").addEventListener("click", (event) => event.detail === 0 && estop()); // by Enter, or by assistive technology
window.addEventListener("keydown", (event) => {
  if (event.code === "Escape" && !event.repeat) order("stop");
  if (event.code !== "Space") return;
  event.preventDefault();
  event.stopPropagation();
  if (!event.repeat) estop();
}, { capture: true });
window.addEventListener("keyup", (event) => event.code === "Space" && event.preventDefault(), { capture: true });

async function order(name, more = {}) {
  return outcome(name, await link.ask({ do: "order", order: name, ...more }));
}

function outcome(what, answer) {
  byId("refusal").textContent = answer.ok ? "" : words("order.refused", { what: words(what), why: answer.text || reason(answer.reason) });
  return answer.ok;
}

/** End this page's own driving; whether planners may be kept out, as by that. */
async function stopDriving() {
  const mine = () => link.newest.gate?.holder === panels.source;
  const held = mine() || link.newest.gate?.mode !== "driving";
  drive.letGo();
  for (let i = 0; i < 20 && mine(); i++) await new Promise((done) => setTimeout(done, 100));
  return held;
}

/** Arm, and let planners drive; one that drives already needs no order. */
async function letPlannersDrive() {
  const answer = await link.ask({ do: "order", order: "arm" });
  if (link.newest.gate?.mode !== "driving") outcome("arm", answer);
}

await loadWords();
const drive = new Drive(link, estop);
const map = new MapView(byId("map"), link, aimed);
const panels = new Panels(link);
const fleet = new FleetView(link, map, chosen);
new ReplayBar(link, chosen); // first: the others look at what it says of the page
new Work(link, { outcome, order, stopDriving, letPlannersDrive, watch: chosen });
new Guide();
new CameraView(link, map);
new Calibration(link, { outcome });
const plots = new Plots(link, { outcome, pointed });

/** Show map and camera as they were at a time that a plot is pointed at; null = as they are. */
function pointed(at) {
  map.take("cursor", at);
  panels.showPast(at);
}

const zones = new Zones(link, map, { outcome, hint });

const tryout = new Tryout(link, { outcome, aim: (on) => aim(on, "tryout.hint") });

// What a press of a button does, as a command line: who has seen it can write a script.
link.onAsk = (command) => {
  const line = commandLine(command, link.robot);
  if (line === null) return;
  byId("command").hidden = false;
  byId("command").lastElementChild.textContent = line;
};

link.on("robots", ({ names }) => {
  const select = byId("robots");
  select.replaceChildren(...names.map((name) => new Option(name, name)));
  const wanted = [link.robot, decodeURIComponent(location.hash.slice(1)), names[0]].find((name) => names.includes(name));
  if (wanted === undefined) return;
  select.value = wanted;
  if (wanted !== link.robot) link.watch(wanted);
});
link.on("facts", ({ mapping }) => (byId("map-none").hidden = mapping !== false));
link.on("robot", () => (byId("map-none").hidden = true));
link.on("hello", ({ role }) => (document.body.dataset.role = role));
link.on("open", (open) => {
  if (!open) link.robot = null; // what was watched is asked for again
});
function look(name) {
  location.hash = encodeURIComponent(name);
  link.watch(name);
}
byId("robots").addEventListener("change", (event) => look(event.target.value));

function chosen(name) {
  byId("robots").value = name;
  if (name !== link.robot) look(name);
  fleet.show(false);
}

byId("arm").onclick = async () => {
  const waiting = link.newest.gate?.waiting.length > 0;
  if ((await order("arm", { hold: !waiting })) && !waiting) drive.keepArmed();
};
// Who drives: asking for it, and handing it over.

let handed = null;
byId("ask").onclick = async () => {
  const holder = link.newest.gate?.holder;
  if (outcome("ask", await link.ask({ do: "ask" }))) byId("refusal").textContent = words("asked", { name: holder });
};
link.on("gate", (gate) => {
  const operator = gate.holder && gate.role !== "tracker";
  const mine = gate.holder === panels.source;
  byId("ask").hidden = !operator || mine;
  const asking = mine && link.newest.hello?.role !== "observer" ? gate.asking : [];
  if (byId("asking").dataset.shown !== asking.join()) {
    byId("asking").dataset.shown = asking.join();
    byId("asking").replaceChildren(...asking.map((name) => {
      const give = element("button", { className: "go", textContent: words("hand_over") });
      give.onclick = async () => outcome("hand_over", await link.ask({ do: "hand_over", to: name }));
      return element("p", {}, element("span", { textContent: words("asking", { name }) }), give);
    }));
  }
  if (gate.handed_to !== handed) {
    handed = gate.handed_to;
    if (handed && handed === panels.source) {
      drive.keepArmed();
      panels.drop("handed");
      panels.banner("handed", words("banner.handed"), "good");
    }
  }
});
for (const name of ["disarm", "stop", "reset"]) byId(name).onclick = () => order(name);

byId("theme").onclick = () => {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("theme", next);
  map.readColours();
  if (plots.uPlot) plots.show();
  if (fleet.open) fleet.draw();
};

// Map and goals

function press(id, on) {
  byId(id).setAttribute("aria-pressed", on);
}
byId("tool-follow").onclick = () => map.setFollow(!map.follow);
map.onFollow = (on) => press("tool-follow", on);
byId("tool-heading").onclick = () => {
  map.setHeadingUp(!map.headingUp);
  press("tool-heading", map.headingUp);
};
byId("tool-in").onclick = () => map.zoom(1.3);
byId("tool-out").onclick = () => map.zoom(1 / 1.3);
byId("tool-fit").onclick = () => map.fit();
byId("tool-goal").onclick = () => {
  const on = !map.aiming || tryout.placing;
  tryout.place(false);
  aim(on);
};

byId("tool-draw").onclick = () => {
  tryout.place(false);
  draw(!map.drawing);
};

byId("tool-zone").onclick = () => {
  const on = !map.corners;
  tryout.place(false);
  aim(false);
  draw(false);
  zones.draw(on);
};

function aim(on, why = "goal.hint") {
  if (on) draw(false);
  if (on && map.corners) zones.draw(false);
  map.setAiming(on);
  press("tool-goal", on && why === "goal.hint");
  hint(on ? why : null);
}

function draw(on) {
  if (on) aim(false);
  if (on && map.corners) zones.draw(false);
  map.setDrawing(on);
  press("tool-draw", on);
  hint(on ? "map.draw.hint" : null);
}

function hint(key) {
  byId("hint").hidden = key === null;
  if (key !== null) byId("hint").textContent = words(key);
}

function aimed(pose, line = null) {
  if (tryout.take(pose)) return void map.take("pending", null);
  aim(false);
  draw(false);
  map.pending = pose;
  map.drawn = line;
  if (line) map.via = [];
  showGoal();
}

function showWaypoints() {
  const key = JSON.stringify(map.via);
  byId("waypoints").hidden = !map.via.length;
  if (byId("waypoints").dataset.shown === key) return;
  byId("waypoints").dataset.shown = key;
  byId("waypoints").replaceChildren(...map.via.map(([x, y], i) => {
    const drop = element("button", { className: "quiet", textContent: "×", ariaLabel: words("goal.via.drop", { number: i + 1 }) });
    drop.onclick = () => {
      map.take("via", map.via.filter((_, j) => j !== i));
      showGoal();
    };
    return element("li", {}, element("span", { textContent: words("goal.via.row", { x: number(x), y: number(y) }) }), drop);
  }));
}

const LAYERS = ["scan", "trail", "frontiers", "points", "zones", "ground"];
for (const name of LAYERS) {
  const input = element("input", { type: "checkbox", checked: map.layers[name] });
  input.onchange = () => map.setLayer(name, input.checked);
  byId("layers").append(element("label", {}, input, ` ${words(`layer.${name}`)}`));
}
byId("tool-layers").onclick = () => {
  byId("layers").hidden = !byId("layers").hidden;
  byId("tool-layers").setAttribute("aria-expanded", !byId("layers").hidden);
};

/** What the goal does now: nothing drives to it while the gate does not let the robot drive. */
function goalPhase(phase) {
  const mode = link.newest.gate?.mode;
  return ["disarmed", "stopping", "estopped"].includes(mode) && phase !== "paused" ? words(`goal.held.${mode}`) : words(`phase.${phase}`);
}

function showGoal() {
  const state = link.newest.goal;
  const pending = map.pending ?? map.drawn;
  const running = state && state.phase !== "idle";
  byId("goal").hidden = !pending && !(state?.number > 0);
  byId("goal-drop").hidden = !pending;
  byId("goal-go").hidden = byId("goal-via").hidden = !map.pending;
  byId("path-go").hidden = !map.drawn;
  showWaypoints();
  byId("goal-pause").hidden = Boolean(pending) || !running || state.phase === "paused";
  byId("goal-resume").hidden = Boolean(pending) || state?.phase !== "paused";
  byId("goal-cancel").hidden = Boolean(pending) || !running;
  byId("goal-go").textContent = words(link.newest.gate?.mode === "disarmed" ? "goal.arm" : "goal.go");
  let text = "";
  if (map.drawn) text = words("path.drawn", { metres: number(lengthOf(map.drawn), 1) });
  else if (pending) text = words("goal.at", { x: number(pending[0]), y: number(pending[1]), yaw: degrees(pending[2]) });
  else if (running) text = words("goal.state", { number: state.number, phase: goalPhase(state.phase), remaining: number(state.remaining, 1) });
  else if (state?.outcome === "estopped") text = words("goal.estopped", { number: state.number });
  else if (state) text = words("goal.ended", { number: state.number, text: state.text || reason(state.outcome) });
  if (byId("goal-text").textContent !== text) byId("goal-text").textContent = text;
}
link.on("goal", showGoal);
link.on("gate", showGoal);
link.on("robot", showGoal);

byId("goal-go").onclick = async () => {
  const goal = map.pending;
  const held = await stopDriving();
  if (!outcome("map.goal", await link.ask({ do: "goal", goal, via: map.via }))) return;
  map.pending = null;
  map.via = [];
  showGoal();
  if (held) await letPlannersDrive();
};
byId("goal-via").onclick = () => {
  map.via = [...map.via, map.pending.slice(0, 2)];
  map.take("pending", null);
  showGoal();
  aim(true);
};
byId("path-go").onclick = async () => {
  const held = await stopDriving();
  if (!outcome("map.draw", await link.ask({ do: "track", points: map.drawn }))) return;
  map.take("drawn", null);
  showGoal();
  if (held) await letPlannersDrive();
};
byId("goal-drop").onclick = () => {
  map.drawn = null;
  map.via = [];
  map.take("pending", null);
  showGoal();
};
for (const name of ["pause", "resume", "cancel"]) {
  byId(`goal-${name}`).onclick = async () => outcome(`goal.${name}`, await link.ask({ do: "goal_control", order: name }));
}

function lengthOf(line) {
  return line.slice(1).reduce((sum, [x, y], i) => sum + Math.hypot(x - line[i][0], y - line[i][1]), 0);
}

document.documentElement.dataset.ready = "true";
