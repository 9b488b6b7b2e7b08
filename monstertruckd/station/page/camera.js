// The camera large, over the map, with the path and the ground that the robot is about to cover drawn into its picture.
import { byId } from "./dom.js";
import { moved, projected, relative } from "./geometry.js";

const STEP = 0.05; // metres between two points of a line
const AHEAD = 2.5; // metres of the way that are drawn for the robot's edges
const FAR = 6; // metres from the robot up to which a path is drawn

export class CameraView {
  constructor(link, map) {
    this.link = link;
    this.map = map;
    link.on("robot", () => this.show(false));
    link.on("facts", () => this.offer());
    link.on("camera", () => this.offer());
    byId("camera-large").onclick = () => this.show(true);
    byId("camera-close").onclick = () => this.show(false);
    byId("camera-picture").onload = () => this.draw();
    new ResizeObserver(() => this.draw()).observe(byId("camera-view"));
  }

  offer() {
    byId("camera-large").hidden = !("camera" in this.link.newest);
  }

  show(on) {
    byId("camera-view").hidden = !on;
    this.offer();
    if (on) byId("camera-picture").src = byId("camera").src;
    byId(on ? "camera-close" : "camera-large").focus();
  }

  /** Mount of the camera in base; null while it is unknown. */
  mount() {
    const row = this.link.newest.transforms?.tree.camera;
    return row && { translation: row.slice(1, 4), rotation: row.slice(4, 8) };
  }

  /** Lines on the ground in base: the path, and the robot's edges on the way that is commanded. */
  lines() {
    const { pose, path } = this.map;
    const { length, width } = this.map.shape();
    const rows = [];
    if (pose && path) {
      const near = path.points.map((point) => relative(pose, point)).filter(([x, y]) => Math.hypot(x, y) < FAR);
      rows.push({ name: path.deformed ? "deformed" : "route", points: near });
    }
    const { vx = 0, vy = 0, wz = 0 } = this.link.newest.gate?.twist ?? {};
    const speed = Math.hypot(vx, vy);
    const twist = speed > 0.005 && vx > 0 ? [vx / speed, vy / speed, wz / speed] : [1, 0, 0];
    for (const side of [1, -1]) {
      const points = [];
      for (let s = 0; s <= AHEAD; s += STEP) {
        const [x, y, a] = moved([0, 0, 0], twist, s);
        points.push([x + (Math.cos(a) * length) / 2 - (Math.sin(a) * side * width) / 2, y + (Math.sin(a) * length) / 2 + (Math.cos(a) * side * width) / 2]);
      }
      rows.push({ name: "ghost", points });
    }
    return rows;
  }

  draw() {
    if (byId("camera-view").hidden) return;
    const image = byId("camera-picture");
    const canvas = byId("camera-lines");
    const ratio = window.devicePixelRatio || 1;
    const [across, down] = [image.naturalWidth || 4, image.naturalHeight || 3];
    const scale = Math.min(image.clientWidth / across, image.clientHeight / down);
    const [width, height] = [across * scale, down * scale];
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    const place = { left: (image.clientWidth - width) / 2, top: (image.clientHeight - height) / 2, width, height };
    for (const [name, value] of Object.entries(place)) canvas.style[name] = `${value}px`;
    const mount = this.mount();
    const lens = this.link.newest.facts?.lens;
    let drawn = 0;
    const c = canvas.getContext("2d");
    c.lineWidth = 3 * ratio;
    for (const { name, points } of mount && lens ? this.lines() : []) {
      c.strokeStyle = this.map.colour[name];
      c.beginPath();
      let before = null;
      for (const [x, y] of points) {
        const at = projected([x, y, 0], mount, lens);
        if (at && before) drawn += 1;
        if (at) before ? c.lineTo(at[0] * canvas.width, at[1] * canvas.height) : c.moveTo(at[0] * canvas.width, at[1] * canvas.height);
        before = at;
      }
      c.stroke();
    }
    canvas.dataset.drawn = drawn;
  }
}
