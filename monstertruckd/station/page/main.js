import { Calibration } from "./calibration.js";
import { CameraView } from "./camera.js";
import { commandLine } from "./commandline.js";
import { byId, element } from "./dom.js";
import { Drive } from "./drive.js";
import { Events } from "./events.js";
import { FleetView } from "./fleet.js";
import { Goals } from "./goal.js";
import { Guide } from "./guide.js";
import { MapView } from "./map.js";
import { watchMapFiles } from "./mapfile.js";
import { MissionTool } from "./mission.js";
import { Panels } from "./panels.js";
import { Places } from "./places.js";
import { Plots } from "./plots.js";
import { ReplayBar } from "./replay.js";
import { Link } from "./socket.js";
import { Tools } from "./tools.js";
import { Tryout } from "./tryout.js";
import { loadWords, reason, words } from "./words.js";
import { Work } from "./work.js";
import { Zones } from "./zones.js";

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
  if (!answer.ok) byId("refusal").scrollIntoView({ block: "nearest" });
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
const map = new MapView(byId("map"), link);
const tools = new Tools(map);
const panels = new Panels(link);
const fleet = new FleetView(link, map, chosen);
new ReplayBar(link, chosen); // first: the others look at what it says of the page
/** @type {import("./dom.js").Page} */
const page = {
  outcome,
  order,
  stopDriving,
  letPlannersDrive,
  begin: (what, command) => work.begin(what, command),
  go: (pose) => goals.go(pose),
  watch: chosen,
  pointed(at) {
    map.take("cursor", at);
    panels.showPast(at);
  },
  dateOf: (stamp) => panels.dateOf(stamp),
};
const work = new Work(link, page);
const goals = new Goals(link, map, tools, page);
new Zones(link, map, tools, page);
new MissionTool(link, map, tools, page);
watchMapFiles(link, map);
new Places(link, map, tools, page);
new Tryout(link, tools, page);
new Events(link, page);
new Calibration(link, page);
const plots = new Plots(link, page);
new CameraView(link, map);
new Guide();

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
link.on("robot", () => (byId("map-none").hidden = byId("command").hidden = true));
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

// Map

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

document.documentElement.dataset.ready = "true";
