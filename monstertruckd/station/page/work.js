// The panes of tasks, settings and recordings.
import { byId, element } from "./dom.js";
import { number, reason, words } from "./words.js";

function button(text, press, look = "") {
  const made = element("button", { textContent: text, className: look });
  made.onclick = press;
  return made;
}

export class Work {
  /**
   * @param {import("./socket.js").Link} link
   * @param {import("./dom.js").Page} page
   */
  constructor(link, page) {
    this.link = link;
    this.page = page;
    /** Number of the mission whose end was told; null while one runs, undefined before the robot said; @type {number | null | undefined} */
    this.told = undefined;
    link.on("fetching", ({ name, share }) => {
      const bar = byId("recordings").querySelector(`[data-name="${name}"] progress`);
      if (bar) bar.value = share;
    });
    for (const kind of ["facts", "robot", "explore", "mission", "behaviour", "hello"]) link.on(kind, () => this.showTasks());
    link.on("robot", () => this.clear());
    link.on("mission", (mission) => this.tellEnd(mission));
    link.on("event", ({ reason: why }) => {
      if (why === "setting_changed" && !byId("pane-settings").hidden) this.loadSettings();
      if (why === "recording_deleted" && !byId("pane-recordings").hidden) this.loadRecordings();
    });
    byId("tab-settings").addEventListener("click", () => this.loadSettings());
    byId("tab-recordings").addEventListener("click", () => this.loadRecordings());
    byId("settings-find").oninput = byId("settings-changed").onchange = () => this.filterSettings();
    byId("recordings-again").onclick = () => this.loadRecordings();
    byId("explore-start").onclick = () => this.begin("task.explore", { do: "explore", order: "start" });
    byId("explore-stop").onclick = () => this.ask("task.explore", { do: "explore", order: "stop" });
    byId("path-start").onclick = () => this.begin("task.path", { do: "start_path", path: this.link.newest.facts.path });
    byId("path-open").onclick = () => byId("path-file").click();
    byId("path-file").onchange = () => this.startPath();
    byId("mission-start").onclick = () => byId("mission-file").click();
    byId("mission-file").onchange = () => this.startMission();
    byId("mission-resume").onclick = () => this.resumeMission();
    byId("mission-moved").onclick = () => this.resumeMission({ moved: true });
    byId("mission-stop").onclick = () => this.ask("task.mission", { do: "mission", order: "stop" });
  }

  get engineer() {
    return this.link.newest.hello?.role === "engineer";
  }

  clear() {
    this.elsewhere = false;
    this.told = undefined;
    byId("settings").replaceChildren();
    byId("recordings").replaceChildren();
    if (!byId("pane-settings").hidden) this.loadSettings();
    if (!byId("pane-recordings").hidden) this.loadRecordings();
  }

  /** Say why a mission ended before it was done, once, also to people who look at another pane. */
  tellEnd({ running, number: mission, outcome, text }) {
    const news = !running && this.told !== undefined && this.told !== mission;
    this.told = running ? null : mission;
    if (news && !["mission_done", "cancelled"].includes(outcome)) this.page.outcome("task.mission", { ok: false, text, reason: outcome });
  }

  async ask(what, command) {
    const answer = await this.link.ask(command);
    this.page.outcome(what, answer);
    return answer;
  }

  // Tasks

  /** Start a task and let planners drive. A robot is armed only when nothing else is in the way, and held until the task has begun, for it may have a path of its own. */
  async begin(what, command) {
    const held = await this.page.stopDriving();
    let answer = await this.link.ask(command);
    const arms = answer.reason === "disarmed";
    if (arms) {
      if (!(await this.page.order("arm", { hold: true }))) return answer;
      answer = await this.link.ask(command);
    }
    const begun = this.page.outcome(what, answer);
    if (begun && held) this.page.letPlannersDrive();
    else if (!begun && arms) this.link.ask({ do: "order", order: "disarm" });
    return answer;
  }

  showTasks() {
    const { facts, explore, mission, behaviour } = this.link.newest;
    const observer = this.link.newest.hello?.role === "observer";
    const text = (id, value) => byId(id).textContent !== value && (byId(id).textContent = value);
    byId("task-explore").hidden = !facts?.explores;
    const exploring = explore && explore.phase !== "idle";
    byId("explore-start").hidden = exploring || observer;
    byId("explore-stop").hidden = !exploring || observer;
    text("explore-state", exploring ? words("task.explore.state", { frontiers: explore.frontiers, known: number(explore.known, 0), metres: number(explore.travelled, 0) })
      : explore?.number ? explore.text || reason(explore.outcome) : words("task.none"));
    byId("task-path").hidden = !facts?.tracks;
    byId("path-note").hidden = !facts?.path;
    byId("path-start").hidden = !facts?.path || observer;
    byId("path-open").hidden = byId("path-lap").hidden = observer;
    text("path-start", words("task.path.start", { name: facts?.path ?? "" }));
    byId("task-mission").hidden = !facts?.goals;
    byId("mission-start").hidden = mission?.running || observer;
    byId("mission-stop").hidden = !mission?.running || observer;
    byId("mission-resume").hidden = !mission?.resumable || observer;
    byId("mission-moved").hidden = !this.elsewhere || !mission?.resumable || observer;
    text("mission-state", mission?.running ? words("task.mission.state", { name: mission.name, step: mission.node || mission.step, steps: mission.steps, doing: mission.doing })
      : mission?.number || mission?.resumable ? mission.text || reason(mission.outcome) : words("task.none"));
    this.showDocks(Object.keys(facts?.docks ?? {}), mission?.running || observer);
    this.showLines(mission?.running || mission?.resumable ? mission.lines ?? [] : []);
    const names = facts?.behaviours ?? [];
    byId("task-behaviours").hidden = !names.length;
    const key = `${names.join()}|${behaviour?.running ? behaviour.behaviour : ""}|${observer}`;
    if (byId("behaviours").dataset.shown !== key) {
      byId("behaviours").dataset.shown = key;
      byId("behaviours").replaceChildren(...(observer ? [] : names.map((name) => {
        const runs = behaviour?.running && behaviour.behaviour === name;
        return button(words(runs ? "task.behaviour.stop" : "task.behaviour.start", { name: title(name) }),
          () => (runs ? this.ask("task.behaviour", { do: "behave", order: "stop", behaviour: name })
            : this.begin("task.behaviour", { do: "behave", order: "start", behaviour: name })), runs ? "go" : "");
      })));
    }
    text("behaviour-state", behaviour?.running ? words("task.behaviour.state", { name: title(behaviour.behaviour), phase: behaviour.phase, seconds: number(behaviour.elapsed, 0) })
      : behaviour?.number ? behaviour.text || reason(behaviour.outcome) : words("task.none"));
    byId("tasks-none").hidden = Boolean(facts?.explores || facts?.tracks || facts?.goals || names.length);
  }

  // Each dock is a mission of one step, and so is leaving it.
  showDocks(names, hidden) {
    const key = `${names.join()}|${hidden}`;
    if (byId("docks").dataset.shown === key) return;
    byId("docks").dataset.shown = key;
    byId("docks").replaceChildren(...(hidden ? [] : names.flatMap((name) => ["dock", "undock"].map((step) =>
      button(words(`task.${step}`, { name: title(name) }),
        () => this.begin("task.mission", { do: "mission", order: "start", text: JSON.stringify({ version: 2, name: step, steps: [{ do: step, dock: name }] }) }))))));
  }

  // The steps of the mission around the present one, which is marked, as are the steps that contain it.
  showLines(lines) {
    const key = JSON.stringify(lines);
    if (byId("mission-lines").dataset.shown === key) return;
    byId("mission-lines").dataset.shown = key;
    const present = lines.findLastIndex((line) => line.active);
    byId("mission-lines").replaceChildren(...lines.map((line, index) => {
      const item = document.createElement("li");
      item.textContent = `${line.number}  ${line.text}`;
      item.style.paddingLeft = `${line.depth}em`;
      if (line.active) item.className = "active";
      if (index === present) item.ariaCurrent = "step";
      return item;
    }));
  }

  async startPath() {
    const [file] = byId("path-file").files;
    byId("path-file").value = "";
    const closed = byId("path-closed").checked;
    if (file) this.begin("task.path", { do: "track_file", name: file.name, text: await file.text(), closed });
  }

  async startMission() {
    const [file] = byId("mission-file").files;
    byId("mission-file").value = "";
    if (file) this.begin("task.mission", { do: "mission", order: "start", text: await file.text() });
  }

  async resumeMission(more = {}) {
    const answer = await this.begin("task.mission", { do: "mission", order: "resume", ...more });
    // The robot is not where it was interrupted; one that does not know its place on a saved map has to find it.
    const placeless = ["searching", "outside"].includes(this.link.newest.slam?.standing);
    this.elsewhere = answer.reason === "pose_lost" && !placeless;
    this.showTasks();
  }

  // Settings

  async loadSettings() {
    if (document.body.dataset.replay === "true") return;
    const answer = await this.link.ask({ do: "settings" });
    if (!this.page.outcome("tab.settings", answer)) return;
    byId("settings").replaceChildren(...answer.value.settings.map((row) => this.setting(row)));
    this.filterSettings();
    byId("settings-save-row").hidden = !this.engineer;
  }

  /** Show the settings whose name, key or meaning has every word that is searched, and of those only changed ones if so wished. */
  filterSettings() {
    const wanted = byId("settings-find").value.toLowerCase().split(/\s+/);
    for (const row of byId("settings").children) {
      const found = wanted.every((word) => row.textContent.toLowerCase().includes(word));
      row.hidden = !found || (byId("settings-changed").checked && !row.classList.contains("changed"));
    }
  }

  /** One setting by its name, in degrees where the robot counts in radians. */
  setting({ key, value, began, meaning, above, at_least, below, at_most }) {
    const id = `setting-${key.replaceAll(".", "-")}`;
    const unit = unitOf(meaning);
    const shown = (number) => (typeof number === "number" ? String(Number((number * unit.factor).toPrecision(6))) : String(number));
    const input = element("input", { id, value: shown(value), disabled: !this.engineer, inputMode: "decimal", autocomplete: "off" });
    input.setAttribute("aria-describedby", `${id}-note`);
    const set = async (wanted) => {
      const answer = await this.link.ask({ do: "set", key, value: wanted, save: byId("settings-save").checked });
      if (!this.page.outcome(key, answer)) input.value = shown(value);
    };
    input.onchange = () => {
      if (input.value === shown(value)) return;
      const typed = Number(input.value.replace(",", "."));
      set(Number.isFinite(typed) && input.value.trim() ? typed / unit.factor : input.value);
    };
    const bounds = [[">", above], ["≥", at_least], ["<", below], ["≤", at_most]]
      .filter(([, bound]) => bound !== null).map(([sign, bound]) => `${sign} ${Number((bound * unit.factor).toPrecision(4))}${unit.name && ` ${unit.name}`}`).join(", ");
    const changed = value === began ? "" : words("settings.began", { value: `${shown(began)}${unit.name && ` ${unit.name}`}` });
    const note = element("p", { id: `${id}-note`, className: "note", textContent: [meaning, bounds, changed].filter(Boolean).join(" · ") });
    if (changed && this.engineer) note.append(" ", button(words("settings.reset"), () => set(began)));
    const name = key.split(".").slice(-2).join(" ").replaceAll("_", " ");
    return element("div", { className: `setting${changed ? " changed" : ""}` },
      element("label", { htmlFor: id }, `${name[0].toUpperCase()}${name.slice(1)}${unit.name && `, ${unit.name}`}`, element("small", {}, ...breakable(key))), input, note);
  }

  // Recordings

  async loadRecordings() {
    if (document.body.dataset.replay === "true") return;
    const answer = await this.link.ask({ do: "recordings" });
    if (!this.page.outcome("tab.recordings", answer)) return;
    const rows = answer.value.recordings;
    byId("recordings-none").hidden = rows.length > 0;
    byId("recordings").replaceChildren(...rows.map((row) => this.recording(row)));
  }

  recording({ name, bytes, modified, kind, open }) {
    const date = new Date(modified * 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" });
    const facts = [date, `${number(bytes / 1e6, 1)} MB`, words(`recordings.${open ? "open" : kind}`)].join(" · ");
    const actions = element("div", { className: "row" });
    const item = element("li", {}, element("strong", { textContent: name }), element("small", { textContent: facts }), actions);
    const offer = () => {
      actions.replaceChildren();
      if (this.link.newest.hello?.role !== "observer") {
        const href = `/robots/${encodeURIComponent(this.link.robot)}/recordings/${encodeURIComponent(name)}`;
        actions.append(element("a", { href, download: name, className: "button", textContent: words("recordings.download"), ariaLabel: `${words("recordings.download")}: ${name}` }));
      }
      if (this.link.newest.hello?.role !== "observer") actions.append(button(words("recordings.replay"), replay));
      if (this.engineer && !open) actions.append(button(words("recordings.delete"), confirm));
    };
    const replay = async () => {
      actions.replaceChildren(element("p", { className: "note", textContent: words("recordings.wait") }), element("progress", { max: 1, value: 0, ariaLabel: words("recordings.fetching", { name }) }));
      const answer = await this.link.ask({ do: "replay", name });
      offer();
      if (this.page.outcome("recordings.replay", answer)) this.page.watch(answer.value.robot);
    };
    const confirm = () => {
      const sure = button(words("recordings.sure", { size: `${number(bytes / 1e6, 1)} MB` }), async () => {
        if (this.page.outcome("recordings.delete", await this.link.ask({ do: "delete_recording", name }))) this.loadRecordings();
      }, "danger");
      actions.replaceChildren(sure, button(words("recordings.keep"), offer));
      sure.focus();
    };
    item.dataset.name = name;
    offer();
    return item;
  }
}

/** Unit that a setting's meaning names last, and by what its value is multiplied for people: degrees instead of radians. */
export function unitOf(meaning) {
  const [, name = ""] = /(?:, |\()(rad(?:\/s(?:\^2)?)?|m(?:\/s(?:\^2)?)?|s|Hz|V|1\/m|%|N|kg)\)?\.?$/.exec(meaning.trim()) ?? [];
  const unit = name.replace("^2", "²");
  return unit.startsWith("rad") ? { name: unit.replace("rad", "°"), factor: 180 / Math.PI } : { name: unit, factor: 1 };
}

/** A configured name as people write it. */
const title = (name) => name.replaceAll("_", " ");

/** A dotted name that may be broken behind its dots and underscores. */
function breakable(key) {
  return key.split(/(?<=[._])/).flatMap((part) => [part, document.createElement("wbr")]);
}
