// Every text of the page comes from one table, by key; `{name}` in it is replaced.
let table = {};
const STILL = 0.005; // m/s and rad/s: less is standing

/** @returns {any[]} elements that have this attribute */
const having = (attribute) => [...document.querySelectorAll(`[${attribute}]`)];

export async function loadWords() {
  table = await (await fetch("/strings.json")).json();
  for (const element of having("data-s")) element.textContent = words(element.dataset.s);
  for (const element of having("data-aria")) element.setAttribute("aria-label", words(element.dataset.aria));
  for (const element of having("data-alt")) element.alt = words(element.dataset.alt);
  for (const element of having("data-hint")) element.placeholder = words(element.dataset.hint);
  for (const element of having("data-label")) {
    element.setAttribute("aria-label", words(element.dataset.label));
    element.title = words(element.dataset.label);
  }
}

export function words(key, values = {}) {
  return (table[key] ?? key).replace(/\{(\w+)\}/g, (whole, name) => values[name] ?? whole);
}

/** Whether the gate commands a motion. */
export const moves = (gate) => Boolean(gate?.twist) && Math.hypot(gate.twist.vx, gate.twist.vy, gate.twist.wz) > STILL;

// The gate's mode, and that the robot has not come to rest yet. A robot that is told to stand is armed, whoever holds the lease.
export function modeText(mode, stopping, gate = null) {
  const shown = mode === "driving" && gate && !moves(gate) ? "armed" : mode ?? "unknown";
  const text = words(`mode.${shown}`);
  return stopping && mode !== "stopping" ? `${text}, ${words("mode.stopping").toLowerCase()}` : text;
}

export const reason = (code) => words(`reason.${code}`);
export const number = (value, digits = 2) => (Number.isFinite(value) ? value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1") : "–");
export const degrees = (radians, digits = 0) => number((radians * 180) / Math.PI, digits);
