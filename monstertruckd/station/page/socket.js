// The one WebSocket to the station: newest messages by kind with their time of arrival, and answers to orders.
const RETRY = 1000;
const PING = 500;
const ECHOES = 20; // answers to pings, of which the quickest one counts
const KEPT = ["open", "hello", "robots", "fleet", "pilot", "stops", "emulated"]; // what the station says, not a robot

export class Link {
  constructor() {
    this.newest = {};
    this.arrived = {};
    this.listeners = {};
    this.delay = null; // ms to the station and back
    this.asked = null; // since when a ping waits for its answer
    this.echoes = []; // [the station's time, the browser's at which it came], ms
    this.open = false;
    this.waiting = new Map();
    this.number = 0;
    this.robot = null;
    /** @type {((command: any) => void) | null} is called with each command that has an outcome */
    this.onAsk = null;
    setInterval(() => this.ping(), PING);
    this.connect();
  }

  on(kind, take) {
    (this.listeners[kind] ??= []).push(take);
    if (kind in this.newest) take(this.newest[kind]);
  }

  emit(kind, message) {
    this.newest[kind] = message;
    this.arrived[kind] = performance.now();
    for (const take of this.listeners[kind] ?? []) take(message);
  }

  /** Seconds since a message of this kind came; infinite before the first. */
  age(kind) {
    return kind in this.arrived ? (performance.now() - this.arrived[kind]) / 1000 : Infinity;
  }

  connect() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onmessage = (event) => this.take(event.data);
    socket.onopen = () => this.setOpen(true);
    socket.onclose = () => {
      this.setOpen(false);
      this.settle();
      setTimeout(() => this.connect(), RETRY);
    };
  }

  setOpen(open) {
    this.open = open;
    this.delay = this.asked = null;
    this.echoes = [];
    if (open) this.ping();
    if (this.newest.open !== open) this.emit("open", open); // its age is that of the loss, not of the newest attempt
  }

  ping() {
    const at = performance.now();
    if (this.send({ do: "ping", at })) this.asked ??= at;
  }

  /** The station's time and how long ago it was that, ms, by the answer that was least under way; null before the first. */
  heard(at) {
    if (!this.echoes.length) return null;
    const [time, came] = this.echoes.reduce((best, echo) => (echo[0] - echo[1] >= best[0] - best[1] ? echo : best));
    return { heard: time, since: Math.max(at - came, 0) };
  }

  take(data) {
    let message;
    if (typeof data === "string") message = JSON.parse(data);
    else {
      const length = new DataView(data).getUint32(0, true);
      message = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      message.payload = data.slice(4 + length);
    }
    const kind = message.kind;
    if (kind === "answer") {
      this.waiting.get(message.id)?.(message);
      this.waiting.delete(message.id);
    } else if (kind === "pong") {
      const now = performance.now();
      const delay = now - message.at;
      this.asked = null;
      this.echoes.push([message.now, now]);
      if (this.echoes.length > ECHOES) this.echoes.shift();
      this.delay = this.delay === null ? delay : Math.max(delay, 0.8 * this.delay + 0.2 * delay);
    } else {
      if (kind === "robot") this.forget();
      this.emit(kind, message.m ?? message);
    }
  }

  /** What was said of a robot is void: another one is shown, or it began anew. */
  forget() {
    for (const kind of Object.keys(this.newest)) if (!KEPT.includes(kind)) delete this.newest[kind], delete this.arrived[kind];
  }

  /** Nobody answers any longer what waits for an answer. */
  settle() {
    for (const done of this.waiting.values()) done({ ok: false, reason: "timeout", text: "" });
    this.waiting.clear();
  }

  /** Send at once, or not at all. */
  send(command) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(command));
    return true;
  }

  /** Send and wait for the outcome. */
  ask(command) {
    const id = ++this.number;
    this.onAsk?.(command);
    return new Promise((settle) => {
      this.waiting.set(id, settle);
      if (!this.send({ ...command, id })) {
        this.waiting.delete(id);
        settle({ ok: false, reason: "timeout", text: "" });
      }
    });
  }

  watch(robot) {
    this.forget();
    delete this.newest.pilot;
    this.settle(); // the session that they were asked by ends
    this.robot = robot;
    this.send({ do: "watch", robot });
  }

  /** Milliseconds there and back from the browser to the station, and from there to the robot; only while both are known. */
  delays() {
    const waits = this.asked === null ? 0 : performance.now() - this.asked;
    return { browser: Math.max(this.delay, waits), robot: 1000 * this.newest.link.round_trip };
  }

  /** Milliseconds from a hand to the robot and back to the screen; null while unknown. */
  roundTrip() {
    const robot = this.newest.link?.round_trip;
    if (this.delay === null || robot == null) return null;
    const { browser } = this.delays();
    return browser + 1000 * robot;
  }
}
