import { Drive } from "./drive.js";
import { FleetView } from "./fleet.js";
import { MapView } from "./map.js";
import { Panels } from "./panels.js";
import { Link } from "./socket.js";
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

await loadWords();
const drive = new Drive(link);
const map = new MapView(byId("map"), link, aimed);
const panels = new Panels(link);
const fleet = new FleetView(link, map, chosen);

link.on("robots", ({ names }) => {
  const select = byId("robots");
  select.replaceChildren(...names.map((name) => new Option(name, name)));
  const wanted = [link.robot, decodeURIComponent(location.hash.slice(1)), names[0]].find((name) => names.includes(name));
  if (wanted === undefined) return;
  select.value = wanted;
  if (wanted !== link.robot) link.watch(wanted);
});
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
for (const name of ["disarm", "stop", "reset"]) byId(name).onclick = () => order(name);

byId("theme").onclick = () => {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("theme", next);
  map.readColours();
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
byId("tool-goal").onclick = () => aim(!map.aiming);

function aim(on) {
  map.setAiming(on);
  press("tool-goal", on);
  byId("hint").hidden = !on;
  byId("hint").textContent = words("goal.hint");
}

function aimed(pose) {
  aim(false);
  map.pending = pose;
  showGoal();
}

function showGoal() {
  const state = link.newest.goal;
  const pending = map.pending;
  const running = state && state.phase !== "idle";
  byId("goal").hidden = !pending && !(state?.number > 0);
  byId("goal-go").hidden = byId("goal-drop").hidden = !pending;
  byId("goal-pause").hidden = Boolean(pending) || !running || state.phase === "paused";
  byId("goal-resume").hidden = Boolean(pending) || state?.phase !== "paused";
  byId("goal-cancel").hidden = Boolean(pending) || !running;
  byId("goal-go").textContent = words(link.newest.gate?.mode === "disarmed" ? "goal.arm" : "goal.go");
  let text = "";
  if (pending) text = words("goal.at", { x: number(pending[0]), y: number(pending[1]), yaw: degrees(pending[2]) });
  else if (running) text = words("goal.state", { number: state.number, phase: words(`phase.${state.phase}`), remaining: number(state.remaining, 1) });
  else if (state) text = words("goal.ended", { number: state.number, text: state.text || reason(state.outcome) });
  if (byId("goal-text").textContent !== text) byId("goal-text").textContent = text;
}
link.on("goal", showGoal);
link.on("gate", showGoal);
link.on("robot", showGoal);

byId("goal-go").onclick = async () => {
  const goal = map.pending;
  const armed = link.newest.gate?.mode !== "disarmed";
  if (!outcome("map.goal", await link.ask({ do: "goal", goal }))) return;
  map.pending = null;
  showGoal();
  if (!armed) await order("arm");
};
byId("goal-drop").onclick = () => {
  map.take("pending", null);
  showGoal();
};
for (const name of ["pause", "resume", "cancel"]) {
  byId(`goal-${name}`).onclick = async () => outcome(`goal.${name}`, await link.ask({ do: "goal_control", order: name }));
}

document.documentElement.dataset.ready = "true";
