// The panels beside the map: safety gate, truck, system, events, banners.
import { byId, element, svg } from "./dom.js";
import { wheelAngles } from "./geometry.js";
import { watchTabs } from "./panes.js";
import { Past } from "./series.js";
import { degrees, modeText, moves, number, reason, words } from "./words.js";

const SILENT = 1.0;
const OLD = 3.0; // seconds after which a value that the robot no longer says has its age
const HOT = 80; // degrees of the computer
const POOR = 250; // ms there and back from which on the slower link is named
const LATE = 0.02; // seconds: one control tick

function setText(id, text, look = null) {
  const target = byId(id);
  if (target.textContent !== text) target.textContent = text;
  if (look !== null) for (const name of ["good", "warn", "bad"]) target.classList.toggle(name, name === look);
}

/** Rows of a description list: [key of the label, value, look]; what is null is left out. */
function rows(id, given) {
  const list = byId(id);
  const wanted = given.filter(([, value]) => value !== null && value !== undefined);
  const keys = wanted.map(([key]) => key).join();
  if (list.dataset.keys !== keys) {
    list.dataset.keys = keys;
    list.replaceChildren(...wanted.flatMap(([key]) => [element("dt", { textContent: words(key) }), element("dd")]));
  }
  wanted.forEach(([, value, look = ""], i) => {
    const cell = list.children[2 * i + 1];
    if (cell.textContent !== value) cell.textContent = value;
    cell.className = look;
  });
}

const LOOKS = { disarmed: "", armed: "warn", driving: "good", stopping: "warn", estopped: "bad" };

export class Panels {
  constructor(link) {
    this.link = link;
    this.seen = new Set();
    this.pictures = new Past(1); // seconds between two pictures: ten minutes of them are some 15 MB
    /** @type {ArrayBuffer | null} the picture that was chosen, until it is drawn */
    this.picture = null;
    this.pointed = null;
    link.on("robot", () => this.clear());
    link.on("stop", (stop) => this.showStop(stop));
    link.on("health", (table) => this.showServices(table));
    link.on("late", ({ seconds }) => this.banner("late", words("banner.late", { seconds: number(seconds) }), "warn"));
    link.on("camera", (message) => this.showPicture(message));
    link.on("trouble", ({ text }) => setText("refusal", text));
    this.buildTop();
    this.buildHorizon();
    watchTabs();
    setInterval(() => this.refresh(), 100);
  }

  clear() {
    this.seen.clear();
    this.pictures.clear();
    this.picture = null;
    byId("services").replaceChildren();
    byId("banners").replaceChildren();
    byId("chain").hidden = byId("stopped").hidden = true;
    byId("camera").hidden = true;
    setText("refusal", "");
  }

  /** By which name the robot knows this page. */
  get source() {
    return this.link.newest.pilot?.source ?? null;
  }

  /** A value with its age, if the robot no longer says what it is; a recording that is shown may stand still. */
  aged(kind, text) {
    const seconds = this.link.age(kind);
    if (seconds < OLD || document.body.dataset.replay === "true") return text;
    return words("old", { value: text, seconds: number(seconds, 0) });
  }

  get alive() {
    return this.link.open && this.link.age("gate") < SILENT;
  }

  refresh() {
    const { newest } = this.link;
    const gate = this.alive ? newest.gate : null;
    this.showLink();
    this.showGate(gate);
    if (!byId("pane-truck").hidden) this.showTruck();
    this.drawPicture();
    if (!byId("pane-system").hidden) this.showSystem();
    const battery = newest.battery;
    byId("chip-battery").hidden = !battery;
    if (battery) {
      const look = { normal: "", low: "warn", critical: "bad", overcharged: "warn", sensor_fault: "warn" }[battery.level] ?? "";
      setText("chip-battery", this.aged("battery", battery.voltage === null ? "– V" : `${number(battery.voltage, 1)} V`), look);
      const key = `battery-${battery.level}`;
      if (look && !this.seen.has(key)) this.banner(key, words("banner.battery", { voltage: number(battery.voltage, 1), level: words(`level.${battery.level}`) }), look);
      if (!look) this.drop("battery-");
    }
    this.warn();
    const silent = this.link.open && !this.alive && this.link.age("robot") > 2;
    const lost = !this.link.open && this.link.age("open") > 2;
    if (lost) this.banner("silent", words("banner.station", { seconds: number(this.link.age("open"), 0) }), "bad");
    else if (silent && newest.gate) this.banner("silent", words("banner.silent", { robot: this.link.robot, seconds: number(this.link.age("gate"), 0) }), "bad");
    else this.drop("silent");
    const facts = newest.facts;
    if (facts?.versions.monstertruckd && newest.hello && facts.versions.monstertruckd !== newest.hello.version) {
      this.banner("versions", words("versions.differ", { robot: facts.versions.monstertruckd, station: newest.hello.version }), "warn");
    }
  }

  /** Banners of tilt, temperature, loop and link. */
  warn() {
    const { gate, compass, host, loop, network } = this.link.newest;
    const tilt = Math.acos(Math.cos(compass?.roll ?? 0) * Math.cos(compass?.pitch ?? 0));
    const rows = [
      ["tilt", gate?.reasons.some((why) => why.startsWith("tilt_")), () => words("banner.tilt", { tilt: degrees(tilt) }), gate?.reasons.includes("tilt_stop") ? "bad" : "warn"],
      ["temperature", host && (host.throttled || host.temperature > HOT), () => words("banner.temperature", { temperature: number(host.temperature, 0) }), "warn"],
      ["loop", loop && loop.lateness_p99 > LATE, () => words("banner.loop", { late: number(loop.lateness_p99 * 1000, 0) }), "warn"],
      ["link", network && ["poor", "unusable", "down"].includes(network.level), () => words("banner.link", { level: words(`level.${network.level}`) }), "warn"],
    ];
    for (const [key, holds, text, look] of rows) holds ? this.banner(key, text(), look) : this.drop(key);
  }

  showLink() {
    const { link } = this;
    if (!link.open) return setText("chip-link", words("link.lost", { seconds: number(link.age("open"), 0) }), "bad");
    const delay = link.roundTrip();
    if (delay === null) return setText("chip-link", words("link.absent"), "bad");
    if (!this.alive && link.newest.gate) return setText("chip-link", words("link.silent", { seconds: number(link.age("gate"), 0) }), "bad");
    const { browser, robot } = link.delays();
    const slow = delay <= POOR ? "link.value" : browser > robot ? "link.slow.browser" : "link.slow.robot";
    setText("chip-link", words(slow, { delay: number(delay <= POOR ? delay : Math.max(browser, robot), 0) }), delay > POOR ? "bad" : delay > 100 ? "warn" : "good");
  }

  showGate(gate) {
    const mode = gate?.mode ?? "unknown";
    const named = modeText(gate?.mode, gate?.stopping, gate);
    setText("mode-name", named);
    byId("authority").dataset.mode = mode;
    setText("chip-mode", named, gate?.stopping ? "bad" : LOOKS[mode] ?? "bad");
    setText("mode-limit", gate && gate.mode !== "disarmed" && gate.mode !== "estopped" ? words("limit", { speed: number(gate.speed_limit) }) : "");
    const list = (gate?.reasons ?? []).map(reason);
    if (byId("reasons").dataset.shown !== list.join()) {
      byId("reasons").dataset.shown = list.join();
      byId("reasons").replaceChildren(...list.map((textContent) => element("li", { textContent })));
    }
    this.showCause(gate);
    const mine = gate?.holder && gate.holder === this.source;
    const [driving, resting] = mine ? ["holder.you", "holder.you.rests"] : ["holder", "holder.rests"];
    const hand = moves(gate) ? driving : resting;
    setText("holder-name", gate?.holder ? words(hand, { name: gate.holder })
      : gate?.waiting.length ? words("holder.waiting", { names: gate.waiting.join(", ") }) : gate ? words("holder.none") : "");
    byId("lease").hidden = !gate?.holder;
    byId("lease").value = gate?.lease_left ?? 0;
    const moving = ["armed", "driving", "stopping"].includes(mode);
    byId("arm").disabled = mode !== "disarmed" || gate.stopping;
    byId("disarm").disabled = !moving;
    byId("stop").disabled = mode !== "driving";
    byId("reset").hidden = mode !== "estopped";
    byId("arm").hidden = mode === "estopped";
  }

  /** Why the robot stands, since when, and what helps: as long as it has not been driven on. */
  showCause(gate) {
    const { stop } = this.link.newest;
    const stands = gate && stop && !stop.ordered && !(gate.mode === "driving" && moves(gate));
    byId("stopped").hidden = !stands;
    if (!stands) return;
    const cause = stop.causes[0];
    const seconds = number(Math.max((gate.stamp - stop.stamp) / 1e9, 0), 0);
    const own = stop.reason === "estop_requested" && cause.source === this.source;
    const key = own ? gate.mode : stop.reason;
    const remedy = words(`remedy.${key}`);
    const text = words("stopped", { time: this.dateOf(stop.stamp).toLocaleTimeString(), seconds, why: own ? words("stopped.you") : this.why(cause) });
    setText("stopped", remedy === `remedy.${key}` ? text : `${text} ${remedy}`);
  }

  /** The text of a cause with its source, which some texts name. */
  why({ text, reason: code, source }) {
    const why = text || reason(code);
    return why.split(/[^\w:@-]+/).includes(source) ? why : words("stopped.by", { why, source });
  }

  /** When a stamp of the robot's clock was, by the newest state of the gate and when it came. */
  dateOf(stamp) {
    const { gate } = this.link.newest;
    return new Date(Date.now() - (gate.stamp - stamp) / 1e6 - 1000 * this.link.age("gate"));
  }

  showStop(stop) {
    byId("chain").hidden = false;
    byId("causes").replaceChildren(...stop.causes.map((cause) => {
      const before = (stop.stamp - cause.since) / 1e9;
      return element("li", {}, element("span", { textContent: cause.text || reason(cause.reason) }),
        element("small", { textContent: ` ${cause.source}${before > 0.005 ? `, ${words("cause.since", { seconds: number(before) })}` : ""}` }));
    }));
  }

  showServices({ services }) {
    const look = { ready: "good", starting: "", backoff: "warn", failed: "bad", stopped: "" };
    byId("services").replaceChildren(...services.map((s) => element("tr", {},
      element("td", { textContent: s.name }, ...(s.detail && s.state !== "ready" ? [element("small", { textContent: s.detail })] : [])),
      element("td", { textContent: words(`state.${s.state}`), className: look[s.state] }),
      element("td", { textContent: String(s.restarts), className: "right" }))));
    const failed = services.filter((s) => s.state === "failed" || s.state === "backoff");
    byId("tab-system").classList.toggle("warn", failed.length > 0);
  }

  showPicture(message) {
    this.pictures.add(message.stamp / 1e9, message.payload);
    if (this.pointed === null) this.picture = message.payload;
    this.drawPicture();
  }

  /** Show the picture of a time that a plot is pointed at; null = the newest. */
  showPast(at) {
    this.pointed = at;
    this.picture = (at === null ? this.pictures.rows.at(-1)?.[1] : this.pictures.at(at)) ?? this.picture;
    this.drawPicture();
  }

  /** Draw the chosen picture, if it is new and somebody can see it. */
  drawPicture() {
    if (!this.picture || (byId("pane-truck").hidden && byId("camera-view").hidden)) return;
    const image = byId("camera");
    const before = image.src;
    image.src = URL.createObjectURL(new Blob([this.picture], { type: "image/jpeg" }));
    this.picture = null;
    if (!byId("camera-view").hidden) byId("camera-picture").src = image.src;
    if (before) URL.revokeObjectURL(before);
    image.alt = words("camera");
    image.hidden = false;
  }

  // Banners stay until they are acknowledged or their cause is gone.

  banner(key, text, look) {
    const shown = byId("banners").querySelector(`[data-key="${key}"]`);
    if (shown) return void (shown.firstChild.textContent = text);
    if (this.seen.has(key)) return;
    const close = element("button", { textContent: words("banner.close") });
    const made = element("div", { className: `banner ${look}` }, element("span", { textContent: text }), close);
    made.dataset.key = key;
    close.onclick = () => {
      this.seen.add(key);
      made.remove();
      const said = made.firstChild.textContent.slice(0, 200);
      if (look !== "good" && this.link.newest.hello?.role !== "observer") this.link.ask({ do: "acknowledge", text: said });
    };
    byId("banners").append(made);
  }

  drop(prefix) {
    for (const key of this.seen) if (key.startsWith(prefix)) this.seen.delete(key);
    for (const shown of byId("banners").querySelectorAll(`[data-key^="${prefix}"]`)) shown.remove();
  }

  // Truck

  buildTop() {
    const top = byId("top");
    top.append(svg("rect", { x: -22, y: -52, width: 44, height: 104, rx: 8, fill: "none", stroke: "currentColor", "stroke-width": 2 }));
    top.append(svg("path", { d: "M-8 -56 L0 -66 L8 -56 Z", fill: "currentColor" }));
    this.wheels = [0, 1, 2, 3].map(() => top.appendChild(svg("rect", { x: -7, y: -15, width: 14, height: 30, rx: 4, fill: "currentColor" })));
  }

  buildHorizon() {
    const horizon = byId("horizon");
    const clip = svg("clipPath", { id: "disc" });
    clip.append(svg("circle", { r: 54 }));
    this.ball = svg("g", {});
    this.ball.append(svg("rect", { x: -90, y: -150, width: 180, height: 150, fill: "#3f86c7" }), svg("rect", { x: -90, y: 0, width: 180, height: 150, fill: "#8a6a42" }),
      svg("path", { d: "M-90 0H90", stroke: "#fff", "stroke-width": 2 }));
    for (const angle of [-20, -10, 10, 20]) this.ball.append(svg("path", { d: `M-14 ${-angle * 2}H14`, stroke: "#fff", "stroke-width": 1 }));
    const group = svg("g", { "clip-path": "url(#disc)" });
    group.append(this.ball);
    horizon.append(clip, group, svg("path", { d: "M-34 0H-12 M12 0H34 M0 -3V3", stroke: "#ffd24a", "stroke-width": 4, "stroke-linecap": "round" }),
      svg("circle", { r: 54, fill: "none", stroke: "currentColor", "stroke-width": 2 }));
  }

  showTruck() {
    const { newest } = this.link;
    const { front = 0, rear = 0 } = newest.steering ?? {};
    const { wheelbase = 0.32 } = newest.facts?.geometry ?? {};
    const places = [[1, 1], [1, -1], [-1, 1], [-1, -1]].map(([i, j]) => [(i * wheelbase) / 2, j * 0.13]);
    const angles = wheelAngles(front, rear, wheelbase, places);
    this.wheels.forEach((wheel, i) => {
      const [x, y] = [i % 2 ? 34 : -34, i < 2 ? -34 : 34];
      wheel.setAttribute("transform", `translate(${x} ${y}) rotate(${(-angles[i] * 180) / Math.PI})`);
    });
    setText("axles", words("truck.axles", { front: degrees(front), rear: degrees(rear) }));
    const { roll = 0, pitch = 0, tilt_valid = false } = newest.compass ?? {};
    this.ball.setAttribute("transform", `rotate(${(-roll * 180) / Math.PI}) translate(0 ${(-pitch * 180 * 2) / Math.PI})`);
    const tilt = words("truck.tilted", { roll: degrees(roll, 1), pitch: degrees(pitch, 1) });
    setText("tilt", newest.compass ? this.aged("compass", tilt) : "–", tilt_valid || !newest.compass ? "" : "warn");
    const { pose, battery, gate, tracker, slam, scan } = newest;
    rows("figures", [
      ["figure.speed", pose ? this.aged("pose", `${number(pose.twist[0])} m/s`) : null],
      ["figure.turn", pose ? this.aged("pose", `${degrees(pose.twist[2])} °/s`) : null],
      ["figure.position", pose ? this.aged("pose", `${number(pose.pose[0])}, ${number(pose.pose[1])} m`) : null],
      ["figure.heading", pose ? this.aged("pose", `${degrees(pose.pose[2])}°`) : null],
      ["figure.battery", battery ? this.aged("battery", `${number(battery.voltage, 1)} V, ${words(`level.${battery.level}`)}`) : null],
      ["figure.charge", battery?.charge != null ? `${number(battery.charge * 100, 0)} %` : null],
      ["figure.stopping", gate ? `${number(gate.stopping_distance)} m` : null],
      ["figure.error", tracker && tracker.outcome === "driving" ? `${number(tracker.cross_track * 100, 1)} cm` : null],
      ["figure.steering", tracker?.steering_differs || null],
      ["figure.lidar", scan?.tilt != null ? this.aged("scan", `${degrees(scan.tilt, 1)}°`) : null],
      ["figure.map", slam ? `${number(slam.overlap * 100, 0)} %` : null],
    ]);
  }

  showUsb() {
    const nodes = this.link.newest.usb?.nodes ?? [];
    const key = JSON.stringify(nodes);
    if (byId("usb").dataset.shown === key) return;
    byId("usb").dataset.shown = key;
    const look = { present: "good", absent: "bad", waiting: "warn", held: "bad" };
    const below = (parent) => nodes.filter((node) => node.parent === parent).map((node) => {
      const facts = [node.name, node.tty, node.usb_id, node.replugs ? words("usb.replugs", { count: node.replugs }) : null].filter(Boolean).join(" · ");
      const inner = below(node.name);
      const state = node.hub && node.state === "present" ? [] : [element("span", { className: `state ${look[node.state]}`, textContent: words(`usb.${node.state}`) })];
      return element("li", {}, element("span", { textContent: node.role ?? (node.title || node.name) }), ...state, element("small", { textContent: facts }),
        ...(inner.length ? [element("ul", {}, ...inner)] : []));
    });
    const roots = below(null);
    byId("usb").replaceChildren(...(roots.length ? roots : [element("li", { textContent: words("usb.none") })]));
  }

  showCalibration() {
    const { wizards = [], proposed = "" } = this.link.newest.calibration ?? {};
    const key = JSON.stringify([wizards, proposed]);
    if (byId("calibration").dataset.shown === key) return;
    byId("calibration").dataset.shown = key;
    byId("calibration").replaceChildren(...(wizards.length ? wizards : [null]).map((row) => row === null
      ? element("tr", {}, element("td", { colSpan: 3, textContent: words("calibration.none") }))
      : element("tr", {},
        element("td", { textContent: row.wizard }, element("small", { textContent: words("calibration.age", { days: Math.max(Math.floor((Date.now() - Date.parse(row.date)) / 864e5), 0) }) })),
        element("td", { textContent: row.grade, className: { A: "good", B: "", C: "warn" }[row.grade] }),
        element("td", { textContent: row.expired ? words("calibration.expired", { why: row.expired }) : row.until.slice(0, 10), className: row.expired ? "bad" : "" }))));
    if (proposed) byId("calibration").append(element("tr", {}, element("td", { colSpan: 3, className: "warn", textContent: words("calibration.proposed", { what: proposed }) })));
  }

  showSystem() {
    this.showUsb();
    this.showCalibration();
    const { host, loop, recorder, network, facts, hello } = this.link.newest;
    const delay = this.link.roundTrip();
    const gigabytes = (bytes) => `${number(bytes / 1e9, 1)} GB`;
    rows("computer", [
      ["computer.browser", delay === null ? null : words("link.value", { delay: number(this.link.delays().browser, 0) })],
      ["computer.link", delay === null ? null : words("link.value", { delay: number(this.link.delays().robot, 0) })],
      [`network.${network?.medium ?? "none"}`, network ? words("network.value", { level: words(`level.${network.level}`), signal: network.signal === null ? "" : `${number(network.signal, 0)} dBm` }) : null],
      ["computer.cpu", host?.cpu != null ? `${number(host.cpu * 100, 0)} %` : null],
      ["computer.temperature", host?.temperature != null ? `${number(host.temperature, 0)} °C` : null],
      ["computer.memory", host ? gigabytes(host.memory_available) : null],
      ["computer.disk", host ? gigabytes(host.disk_free) : null],
      ["computer.tick", loop ? `${number(loop.lateness_p99 * 1000, 1)} ms` : null],
      ["computer.recorder", recorder ? (recorder.recording ? `${number(recorder.bytes_written / 1e6, 1)} MB` : words("computer.recorder.off")) : null],
    ]);
    rows("versions", [
      ["versions.station", hello?.version],
      ["versions.robot", facts?.versions.monstertruckd],
      ...Object.entries(facts?.versions ?? {}).filter(([name]) => ["python", "system", "git"].includes(name)),
    ]);
  }
}
