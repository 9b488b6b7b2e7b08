// The pane of events: newest first, those alike in one row, each with the log at its moment.
import { byId, element } from "./dom.js";
import { reason, words } from "./words.js";

const KEPT = 300; // rows
const TIMES = 20; // of one row that are offered

/** What events alike have in common: numbers in their texts differ. */
export const alike = ({ severity, source, reason: why }, text) => `${severity}|${source}|${why}|${text.replace(/[0-9.]+/g, "#")}`;

/**
 * The recording that holds a moment: of those that were last written after it the earliest; null without one.
 *
 * @param {{name: string, modified: number, kind: string, open: boolean}[]} recordings
 * @param {number} at seconds since 1970
 */
export function holding(recordings, at) {
  const ends = recordings.filter(({ kind }) => kind === "run").map((row) => ({ ...row, end: row.open ? Infinity : row.modified }));
  return ends.filter(({ end }) => end >= at).sort((a, b) => a.end - b.end)[0]?.name ?? null;
}

export class Events {
  /**
   * @param {import("./socket.js").Link} link
   * @param {import("./dom.js").Page} page
   */
  constructor(link, page) {
    this.link = link;
    this.page = page;
    /** @type {Map<string, {event: any, text: string, stamps: number[], count: number, first: number, item?: HTMLElement}>} rows, the newest last */
    this.rows = new Map();
    this.early = []; // events that came before the robot's time was known
    link.on("robot", () => this.clear());
    link.on("event", (event) => {
      this.early.push(event);
      this.list();
    });
    link.on("gate", () => this.list());
    byId("events-least").onchange = ({ target }) => (byId("events").dataset.least = target.value);
  }

  clear() {
    this.rows.clear();
    this.early = [];
    byId("events").replaceChildren();
  }

  /** List the events that have come, once the robot's time is known. */
  list() {
    if (this.link.newest.gate) for (const event of this.early.splice(0)) this.add(event);
  }

  add(event) {
    const text = event.text || reason(event.reason);
    const key = alike(event, text);
    const before = this.rows.get(key);
    before?.item?.remove();
    this.rows.delete(key);
    const row = { event, text, stamps: [event.stamp, ...(before?.stamps ?? [])], count: (before?.count ?? 0) + 1, first: before?.first ?? event.stamp };
    row.stamps.splice(TIMES);
    row.item = this.item(row, before?.item.querySelector("details")?.open ?? false);
    this.rows.set(key, row);
    byId("events").prepend(row.item);
    if (this.rows.size <= KEPT) return;
    const [oldest, { item }] = this.rows.entries().next().value;
    item.remove();
    this.rows.delete(oldest);
  }

  item({ event, text, stamps, count, first }, open) {
    const facts = element("small", { textContent: `${event.source} · ${reason(event.reason)}` });
    const item = element("li", { className: event.severity }, element("span", { textContent: text }), facts);
    if (count === 1) facts.prepend(this.time(event.stamp), " · ");
    else {
      const summary = words("events.count", { count, first: this.clock(first), last: this.clock(event.stamp) });
      item.append(element("details", { open }, element("summary", { textContent: summary }), ...stamps.map((stamp) => this.time(stamp))));
    }
    return item;
  }

  clock(stamp) {
    return this.page.dateOf(stamp).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
  }

  /** The time of an event, which shows the log at that moment. */
  time(stamp) {
    const time = this.clock(stamp);
    if (this.link.newest.hello?.role === "observer") return element("span", { textContent: time });
    const made = element("button", { className: "time", textContent: time, title: words("events.log"), ariaLabel: words("events.log.at", { time }) });
    const date = this.page.dateOf(stamp);
    made.onclick = () => this.show(stamp, date.getTime() / 1000);
    return made;
  }

  /** Show the log at a moment: the recording that is shown already, or the robot's that holds it. */
  async show(stamp, at) {
    if (document.body.dataset.replay === "true") return void this.link.send({ do: "seek", stamp });
    const answer = await this.link.ask({ do: "recordings" });
    if (!this.page.outcome("events.log", answer)) return;
    const name = holding(answer.value.recordings, at);
    if (name === null) return this.page.outcome("events.log", { ok: false, text: words("events.log.none") });
    const replay = await this.link.ask({ do: "replay", name, stamp });
    if (this.page.outcome("events.log", replay)) this.page.watch(replay.value.robot);
  }
}
