// Driving by hand. Every 50 ms the loop below reads the input and sends what it says at that moment; nothing else sends a
// motion. A page that hangs, sleeps in a background tab or lost its link sends nothing, and the robot's lease runs out.
import { byId, setText } from "./dom.js";
import { number, words } from "./words.js";

const BEAT = 50;
const REST = 6; // neutral heartbeats behind the last one, so that the truck stops by its ramp
const GRACE = 5000; // ms for which neutral heartbeats keep an armed truck armed until the hand is on the stick
const DEAD = 0.08;
const BLIND = 0.1; // metres that the truck may travel on the lease and the way of a request
const LEASE = 0.25;
const UNKNOWN = 1500; // ms that the way to the robot and back is taken to be until it is measured
const MODES = ["front", "rear", "counter", "crab", "twist"];
const KEYS = { w: [0, 1], s: [0, -1], a: [-1, 0], d: [1, 0] };
const PAD_ESTOP = 1; // the right one of the four buttons
const UNSEEN = "v"; // held: drives into ground that no sensor has seen
const UNSEEN_WAIT = 10000; // ms for which the button waits for the hand
const ARROWS = { ArrowUp: "w", ArrowDown: "s", ArrowLeft: "a", ArrowRight: "d" };

export class Drive {
  constructor(link, onEstop) {
    this.link = link;
    this.onEstop = onEstop;
    this.padStops = false;
    this.held = new Map(); // names of the keys that are down, by their places on the keyboard
    this.stick = null;
    this.rest = 0;
    this.last = "stick";
    this.grace = 0;
    this.blocked = null; // mode of the gate that does not let the present hand drive
    this.unseen = 0; // until then, or while the hand then drives on, the button counts
    this.steering = byId("steering");
    this.speed = byId("speed");
    for (const mode of MODES) this.steering.add(new Option(words(`steering.${mode}`), mode));
    this.steering.value = "counter";
    link.on("facts", (facts) => this.takeFacts(facts));
    link.on("robot", () => this.letGo());
    this.listen();
    this.showSpeed();
    setInterval(() => this.beat(), BEAT);
  }

  takeFacts(facts) {
    this.facts = facts;
    this.speed.max = facts.gate.speed;
    const axles = facts.body === "truck";
    for (const option of this.steering.options) option.disabled = !axles && option.value !== "twist" && !(option.value === "front" && ["tricycle", "ackermann", "bicycle"].includes(facts.body));
    if (this.steering.selectedOptions[0].disabled) this.steering.value = "twist";
    this.showSpeed();
  }

  listen() {
    const stick = byId("stick");
    const take = (event) => {
      const { left, top, width, height } = stick.getBoundingClientRect();
      let x = ((event.clientX - left) / width) * 2 - 1;
      let y = 1 - ((event.clientY - top) / height) * 2;
      const size = Math.hypot(x, y);
      if (size > 1) [x, y] = [x / size, y / size];
      this.stick = [x, y];
    };
    stick.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      stick.setPointerCapture(event.pointerId);
      this.pointer = event.pointerId;
      take(event);
    });
    stick.addEventListener("pointermove", (event) => {
      if (event.pointerId !== this.pointer) return;
      if (event.buttons & 1) take(event);
      else this.pointer = this.stick = null; // released where the page does not see it: above a menu
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      stick.addEventListener(end, (event) => {
        if (event.pointerId === this.pointer) this.pointer = this.stick = null;
      });
    }
    window.addEventListener("keydown", (event) => this.key(event, true));
    window.addEventListener("keyup", (event) => this.key(event, false));
    // Whoever gets the release of a key or button then, it is not the page.
    for (const end of ["blur", "pagehide", "contextmenu"]) window.addEventListener(end, () => this.letGo());
    for (const end of ["focusin", "mousedown"]) window.addEventListener(end, (event) => typing(event) && this.held.clear());
    document.addEventListener("visibilitychange", () => document.hidden && this.letGo());
    this.speed.addEventListener("input", () => this.showSpeed());
    byId("unseen").addEventListener("click", () => (this.unseen = this.unseen ? 0 : performance.now() + UNSEEN_WAIT));
  }

  key(event, down) {
    const name = ARROWS[event.key] && document.activeElement?.id === "stick" ? ARROWS[event.key] : event.key.toLowerCase();
    // By its place: with Shift or AltGr a key that is released has another name than when it was pressed.
    if (!down) return void this.held.delete(event.code);
    // While Meta is held, no release of another key is seen.
    if (event.ctrlKey || event.altKey || event.metaKey) return void this.held.clear();
    if (typing(event)) return;
    if (name in KEYS || name === UNSEEN) {
      this.held.set(event.code, name);
      event.preventDefault();
    } else if (MODES[Number(name) - 1] && !event.repeat) {
      const option = this.steering.options[Number(name) - 1];
      if (!option.disabled) this.steering.value = option.value;
    }
  }

  letGo() {
    this.held.clear();
    this.stick = this.pointer = null;
    this.grace = this.unseen = 0;
  }

  /** Keep a truck armed while the hand moves to the stick. */
  keepArmed() {
    this.grace = performance.now() + GRACE;
  }

  /** What the hand says now: [input, sideways, ahead], each -1..1; null = no hand. */
  input() {
    // A gamepad is read by every page that is in view: it drives the robot of the one that has the focus.
    const pads = document.hasFocus() ? navigator.getGamepads?.() ?? [] : [];
    const pad = [...pads].find((each) => each?.connected && each.mapping === "standard");
    this.pad = pad ?? null;
    const stops = Boolean(pad?.buttons[PAD_ESTOP]?.pressed);
    if (stops && !this.padStops) this.onEstop();
    this.padStops = stops;
    if (this.stick) return ["stick", ...this.stick];
    const keys = [...new Set(this.held.values())].filter((name) => name in KEYS);
    if (keys.length) {
      const sum = keys.map((key) => KEYS[key]).reduce(([x, y], [kx, ky]) => [x + kx, y + ky], [0, 0]);
      return ["keys", ...sum];
    }
    if (pad?.buttons[5]?.pressed || pad?.buttons[7]?.pressed) {
      const [x, y] = [pad.axes[0], -pad.axes[1]].map((v) => (Math.abs(v) < DEAD ? 0 : v));
      return ["gamepad", x, y];
    }
    return null;
  }

  /** Whether the operator confirms, by button, key or gamepad, that the truck drives into unseen ground. */
  confirms() {
    return this.unseen > 0 || [...this.held.values()].includes(UNSEEN) || Boolean(this.pad?.buttons[4]?.pressed);
  }

  /** Speed allowed by the slider and by the delay: lease and round trip together cost BLIND metres at most. */
  limit() {
    const delay = this.link.roundTrip() ?? UNKNOWN;
    return Math.min(Number(this.speed.value), BLIND / (LEASE + delay / 1000));
  }

  beat() {
    const hand = this.input();
    this.show(hand);
    if (hand) {
      this.rest = REST;
      this.grace = 0;
      this.last = hand[0];
      if (this.unseen) this.unseen = Infinity; // as long as this hand drives
      this.send(hand);
    } else if (this.rest > 0) {
      if (this.unseen === Infinity) this.unseen = 0;
      this.rest--;
      this.send([this.last, 0, 0]);
    } else if (performance.now() < this.grace) this.send(["stick", 0, 0]);
  }

  /** @param {any[]} hand the input, and how far sideways and ahead, -1 to 1 */
  send([input, x, y]) {
    if (this.link.newest.hello?.role === "observer" || document.body.dataset.replay === "true") return;
    const limit = this.limit();
    const speed = Math.abs(y) < DEAD ? 0 : y * limit;
    const steer = -x * (this.facts?.gate.angle ?? 0.36);
    const heard = this.link.heard(performance.now());
    if (!heard) return;
    const motion = { do: "drive", ...heard, input, unseen: this.confirms() };
    switch (this.steering.value) {
      case "front": Object.assign(motion, { speed, front: steer, rear: 0 }); break;
      case "rear": Object.assign(motion, { speed, front: 0, rear: -steer }); break;
      case "counter": Object.assign(motion, { speed, front: steer, rear: -steer }); break;
      case "crab": Object.assign(motion, { speed, front: steer, rear: steer }); break;
      default: motion.twist = [speed, 0, (-x * limit) / 0.2];
    }
    this.link.send(motion);
  }

  show(hand) {
    const knob = byId("knob");
    const radius = byId("stick").clientWidth / 2 - 32;
    knob.style.transform = hand ? `translate(${hand[1] * radius}px, ${-hand[2] * radius}px)` : "";
    byId("stick").classList.toggle("held", Boolean(hand));
    if (this.unseen && this.unseen < performance.now()) this.unseen = 0;
    byId("unseen").setAttribute("aria-pressed", String(this.confirms()));
    const left = Math.ceil((this.grace - performance.now()) / 1000);
    const blocked = hand && ["disarmed", "estopped"].includes(this.link.newest.gate?.mode) ? this.link.newest.gate.mode : null;
    if (blocked !== this.blocked) {
      setText(byId("hand-note"), blocked ? words(`input.blocked.${blocked}`) : "");
      this.blocked = blocked;
    }
    const text = blocked ? words(`input.blocked.${blocked}`)
      : hand ? words(`input.${hand[0]}`)
      : left > 0 ? words("input.grace", { seconds: left })
      : this.pad ? words("input.ready", { name: this.pad.id.slice(0, 24) })
      : words("input.none");
    setText(byId("input"), text);
    const slowed = this.limit() < Number(this.speed.value) - 0.001;
    const delay = this.link.roundTrip();
    const note = delay === null ? "speed.unknown" : "speed.slowed";
    setText(byId("speed-note"), slowed ? words(note, { speed: number(this.limit()), delay: number(delay, 0) }) : "");
  }

  showSpeed() {
    setText(byId("speed-value"), words("speed.value", { speed: number(Number(this.speed.value)) }));
  }
}

/** Whether an event is about a field of text or a list, which take keys themselves. */
function typing({ target }) {
  return target instanceof Element && target.closest("select, input:not([type=range])") !== null;
}
