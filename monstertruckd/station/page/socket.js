// The one WebSocket to the station: newest messages by kind with their time of arrival, and answers to orders.
const RETRY = 1000;
const PING = 500;

export class Link {
  constructor() {
    this.newest = {};
    this.arrived = {};
    this.listeners = {};
    this.delay = null; // ms to the station and back
    this.open = false;
    this.waiting = new Map();
    this.number = 0;
    this.robot = null;
    setInterval(() => this.send({ do: "ping", at: performance.now() }), PING);
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
      for (const settle of this.waiting.values()) settle({ ok: false, reason: "timeout", text: "" });
      this.waiting.clear();
      setTimeout(() => this.connect(), RETRY);
    };
  }

  setOpen(open) {
    this.open = open;
    this.delay = null;
    this.emit("open", open);
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
      const delay = performance.now() - message.at;
      this.delay = this.delay === null ? delay : Math.max(delay, 0.8 * this.delay + 0.2 * delay);
    } else this.emit(kind, message.m ?? message);
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
    return new Promise((settle) => {
      this.waiting.set(id, settle);
      if (!this.send({ ...command, id })) {
        this.waiting.delete(id);
        settle({ ok: false, reason: "timeout", text: "" });
      }
    });
  }

  watch(robot) {
    const kept = ["open", "hello", "robots", "fleet"];
    for (const kind of Object.keys(this.newest)) if (!kept.includes(kind)) delete this.newest[kind], delete this.arrived[kind];
    this.robot = robot;
    this.send({ do: "watch", robot });
  }

  /** Milliseconds from a hand to the robot and back to the screen; null while unknown. */
  roundTrip() {
    const robot = this.newest.link?.round_trip;
    return this.delay === null || robot == null ? null : this.delay + 1000 * robot;
  }
}
