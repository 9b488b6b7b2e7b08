// Values over time for the plots: one column of times, and one for each number. Pure, so that it is tested without a page.

export const KEPT = 600; // seconds that are kept

/**
 * Values of several numbers at the same times.
 *
 * @typedef {(number | null)[]} Column
 */
export class Table {
  constructor() {
    /** @type {number[]} seconds of the robot's clock, rising */
    this.times = [];
    /** @type {Map<string, Column>} */
    this.columns = new Map();
  }

  /** Keep the columns of these numbers, and begin those that are new. */
  choose(names) {
    this.columns = new Map(names.map((name) => [name, this.columns.get(name) ?? this.times.map(() => null)]));
    if (!names.length) this.times = [];
  }

  /** Add one value for each column; a time that is not later than the newest is of a robot that began anew, if it is much earlier. */
  add(at, values) {
    const last = this.times.at(-1);
    if (at < last - 1) this.clear();
    else if (at <= last) return;
    this.times.push(at);
    let i = 0;
    for (const column of this.columns.values()) column.push(values[i++] ?? null);
    const old = this.index(at - KEPT);
    if (old < this.times.length / 10) return; // seldom, for what stays is moved
    this.times.splice(0, old);
    for (const column of this.columns.values()) column.splice(0, old);
  }

  clear() {
    this.times = [];
    for (const name of this.columns.keys()) this.columns.set(name, []);
  }

  /** Place of the first row that is not before this time. */
  index(at) {
    let [low, high] = [0, this.times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] < at) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** Times and columns of these numbers between two times, each value multiplied by its number's factor. */
  between(from, until, names, factors) {
    const [begin, end] = [this.index(from), this.index(until + 1e-9)];
    const scaled = (name, i) => {
      const part = (this.columns.get(name) ?? []).slice(begin, end);
      return factors[i] === 1 ? part : part.map((value) => (value === null ? null : value * factors[i]));
    };
    return [this.times.slice(begin, end), ...names.map(scaled)];
  }

  /** The last value of a number that is not after this time; null without one. */
  value(name, at) {
    const column = this.columns.get(name);
    for (let i = this.index(at + 1e-9) - 1; column && i >= 0; i--) if (column[i] !== null) return column[i];
    return null;
  }
}

/** Newest of what was kept, by its time: a picture or a pose, at most one in `step` seconds. */
export class Past {
  constructor(step) {
    this.step = step;
    this.rows = [];
  }

  add(at, row) {
    const last = this.rows.at(-1)?.[0];
    if (at < last - 1) this.rows = [];
    else if (at < last + this.step) return;
    this.rows.push([at, row]);
    while (this.rows[0][0] < at - KEPT) this.rows.shift();
  }

  clear() {
    this.rows = [];
  }

  /** What was kept last at this time; undefined before the first. */
  at(time) {
    return this.rows.findLast(([at]) => at <= time + this.step)?.[1];
  }
}

const UNIT = /(?:^|[ (,])(rad\/s\^2|rad\/s|rad|m\/s\^2|m\/s|m\^2|m|s|Hz|V|A|W|%|degrees|ns|N|kg)(?=[,;.)]|$| of | by | while | until )/;

/** Unit that the meaning of a number names, and by what its values are multiplied for people: degrees instead of radians. */
export function unitIn(meaning) {
  const name = UNIT.exec(meaning)?.[1] ?? "";
  return name.startsWith("rad") ? { name: name.replace("rad", "°"), factor: 180 / Math.PI } : { name: name === "degrees" ? "°" : name, factor: 1 };
}

/**
 * Names that are meant by what was typed: the one of that name or title, else all whose title and meaning have every word, closest titles first.
 *
 * @param {Record<string, string>} meanings by name
 * @param {string} typed
 * @returns {string[]}
 */
export function matching(meanings, typed) {
  const names = Object.keys(meanings);
  const text = typed.toLowerCase();
  const exact = names.find((name) => name === typed || titleOf(name) === text);
  if (exact) return [exact];
  const parts = text.split(/[\s/:._]+/).filter(Boolean);
  const has = (where) => parts.every((part) => where.toLowerCase().includes(part));
  const rank = (name) => titleOf(name).length + (has(titleOf(name)) ? 0 : 1000);
  return parts.length ? names.filter((name) => has(`${titleOf(name)} ${meanings[name]}`)).sort((a, b) => rank(a) - rank(b)) : [];
}

/** A number's name as people read it. */
export function titleOf(name) {
  const [topic, path] = name.split(":");
  return `${topic.split("/")[1]} ${path}`.replaceAll(/[._]/g, " ");
}
