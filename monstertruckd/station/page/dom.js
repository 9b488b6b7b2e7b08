// Elements of the page.

/**
 * What the page does for its parts.
 *
 * @typedef {object} Page
 * @property {(what: string, answer: any) => boolean} outcome show why something was refused; whether it was not
 * @property {(order: string, more?: object) => Promise<boolean>} order give the gate an order
 * @property {() => Promise<boolean>} stopDriving end this page's own driving; whether planners may be kept out, as by that
 * @property {() => Promise<void>} letPlannersDrive arm, and let planners drive
 * @property {(what: string, command: object) => Promise<any>} begin start a task and let planners drive
 * @property {(pose: number[]) => Promise<void>} go send the robot to a pose
 * @property {(robot: string) => void} watch show a robot, or a recording
 * @property {(at: number | null) => void} pointed show map and camera as they were at a time; null = as they are
 * @property {(stamp: number) => Date} dateOf when a stamp of the robot's clock was
 */

/**
 * The element of index.html with this id, which is there.
 *
 * @param {string} id
 * @returns {any}
 */
export const byId = (id) => document.getElementById(id);

/**
 * Make an element with properties and children.
 *
 * @param {string} name
 * @param {object} [fields]
 * @param {...(Node | string)} children
 * @returns {any}
 */
export function element(name, fields = {}, ...children) {
  const made = Object.assign(document.createElement(name), fields);
  made.append(...children);
  return made;
}

/**
 * Let people type a name as they write it: blanks become dashes and, where names have small letters, capitals small ones.
 *
 * @param {string} id of the field, whose pattern the names have
 * @param {() => void} changed
 */
export function nameField(id, changed) {
  const field = byId(id);
  field.oninput = () => {
    const typed = field.pattern.includes("A-Z") ? field.value : field.value.toLowerCase();
    const [value, at] = [typed.replace(/\s/g, "-"), field.selectionStart];
    if (value !== field.value) {
      field.value = value;
      field.setSelectionRange(at, at);
    }
    changed();
  };
}

/** Make an element of a drawing. */
export function svg(name, fields) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(fields)) made.setAttribute(key, String(value));
  return made;
}

/** Set a text where it has changed: assistive technology tells every change. */
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}
