// The map: grid, tiles, scan, trail, route, footprint, stopping distance and goal on one canvas.
import { compose, moved, outline, wheelAngles, wrapped } from "./geometry.js";
import { Past } from "./series.js";

const COLOURS = ["map", "map-free", "map-wall", "map-grid", "scan", "trail", "route", "deformed", "goal", "ghost", "truck", "ink", "card", "accent", "frontier", "point", "bad", "warn"];
const LIDARS = ["scan", "scan_2"];
const TRAIL_STEP = 0.03;
const TRAIL_LENGTH = 6000;
const POSES = 60;
const ROUGH = 30; // millimetres of standard deviation that are drawn full
const GRASP = 18; // pixels from a place within which a press means it

export class MapView {
  constructor(canvas, link) {
    this.canvas = canvas;
    this.link = link;
    /** @type {import("./tools.js").Tool | null} what takes the presses; null = the map is moved by them */
    this.tool = null;
    /** @type {import("./tools.js").Tool | null} the tool of the finger that is down */
    this.grip = null;
    /** @type {{draw: (c: CanvasRenderingContext2D, px: number) => void}[]} what tools draw over the map */
    this.overlays = [];
    this.centre = [0, 0];
    this.scale = 90; // pixels per metre
    this.rotation = 0;
    this.follow = true;
    /** @type {((on: boolean) => void) | null} */
    this.onFollow = null;
    this.headingUp = false;
    this.layers = { scan: true, trail: true, frontiers: false, points: true, ground: false, zones: true, ...JSON.parse(localStorage.getItem("layers") ?? "{}") };
    this.pointers = new Map();
    this.clear();
    this.readColours();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    this.listen();
    const frame = () => {
      if (this.dirty) {
        this.dirty = false;
        this.draw();
      }
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  clear() {
    this.poses = [];
    this.past = new Past(0.2); // seconds between two poses
    this.cursor = null;
    this.pose = null;
    this.points = {};
    this.trail = [];
    this.grid = null;
    this.canvas.dataset.drawn = false;
    this.tiles = new Map();
    this.path = this.route = null;
    this.goal = null;
    this.ground = null;
    this.zones = [];
    this.wanted = 0;
    this.dirty = true;
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    this.colour = Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
    for (const image of [this.grid, ...this.tiles.values()]) if (image) this.paint(image);
    this.dirty = true;
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.ratio = ratio;
    this.dirty = true;
  }

  listen() {
    const { link } = this;
    link.on("robot", () => this.clear());
    link.on("pose", (message) => this.takePose(message));
    for (const kind of LIDARS) link.on(kind, (message) => this.takeScan(message));
    link.on("path", (message) => this.takePath(message));
    link.on("map", (message) => this.takeMap(message));
    link.on("tile", (message) => this.takeTile(message));
    link.on("goal", (state) => this.take("goal", state.goal));
    link.on("zones", (message) => this.takeZones(message));
    for (const kind of ["gate", "explore", "points", "facts"]) link.on(kind, () => (this.dirty = true));
    link.on("ground", (message) => this.takeGround(message));
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this.release(event));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  take(name, value) {
    this[name] = value;
    this.dirty = true;
  }

  takePose(message) {
    this.pose = message.pose;
    this.twist = message.twist;
    this.poses.push([message.stamp, message.pose]);
    if (this.poses.length > POSES) this.poses.shift();
    this.past.add(message.stamp / 1e9, message.pose);
    const last = this.trail.at(-1);
    if (!last || Math.hypot(last[0] - message.pose[0], last[1] - message.pose[1]) > TRAIL_STEP) {
      this.trail.push(message.pose);
      if (this.trail.length > TRAIL_LENGTH) this.trail.shift();
    }
    if (this.follow) this.centre = message.pose.slice(0, 2);
    this.rotation = this.headingUp ? Math.PI / 2 - message.pose[2] : this.headingUp === null ? this.rotation : 0;
    this.dirty = true;
  }

  /** Pose at a time between those that came, or the nearest. */
  poseAt(stamp) {
    const after = this.poses.findIndex(([at]) => at >= stamp);
    if (after <= 0) return (this.poses[after] ?? this.poses.at(-1))?.[1];
    const [[t0, a], [t1, b]] = [this.poses[after - 1], this.poses[after]];
    const k = (stamp - t0) / (t1 - t0);
    return [a[0] + k * (b[0] - a[0]), a[1] + k * (b[1] - a[1]), a[2] + k * wrapped(b[2] - a[2])];
  }

  /** Pose of a sensor's frame in base, seen from above. */
  mount(frame) {
    const row = this.link.newest.transforms?.tree[frame];
    if (!row || frame === "base") return [0, 0, 0];
    const [parent, x, y, , qx, qy, qz, qw] = row;
    const yaw = Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz));
    return compose(this.mount(parent), [x, y, yaw]);
  }

  takeScan(message) {
    const ranges = new Uint16Array(message.payload);
    const base = this.poseAt(message.stamp + (ranges.length / 2) * message.time_step * 1e9);
    if (!base) return;
    const [x, y, yaw] = compose(base, this.mount(message.frame));
    const points = new Float32Array(2 * ranges.length);
    let count = 0;
    for (let i = 0; i < ranges.length; i++) {
      if (!ranges[i]) continue;
      const angle = yaw + message.start + i * message.step;
      points[count++] = x + (ranges[i] / 1000) * Math.cos(angle);
      points[count++] = y + (ranges[i] / 1000) * Math.sin(angle);
    }
    this.points[message.kind] = points.subarray(0, count);
    this.dirty = true;
  }

  takePath(message) {
    const points = [];
    for (let i = 0; i < message.poses.length; i += 3) points.push(message.poses.slice(i, i + 3));
    const deformed = message.name.includes("deformed");
    this.path = { points, deformed };
    if (!deformed) this.route = points;
    this.dirty = true;
  }

  async takeMap(message) {
    this.wanted = message.version;
    const robot = this.link.robot;
    const reply = await fetch(`/robots/${encodeURIComponent(robot)}/map/${message.version}`);
    if (!reply.ok) return;
    const cells = new Int8Array(await reply.arrayBuffer());
    if (robot !== this.link.robot || this.wanted !== message.version || cells.length !== message.width * message.height) return;
    for (const [place, { version }] of this.tiles) if (version < message.version) this.tiles.delete(place);
    this.grid = this.paint({ ...message, cells });
    this.canvas.dataset.drawn = true;
    this.dirty = true;
  }

  takeTile(message) {
    if (message.version < this.grid?.version) return;
    const image = this.paint({ ...message, cells: new Int8Array(message.payload) });
    this.tiles.set(message.origin.join(), image);
    this.dirty = true;
  }

  async takeGround(message) {
    const cells = new Uint8Array(await new Response(new Blob([message.payload]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
    if (this.link.newest.ground !== message || cells.length !== message.width * message.height) return;
    const canvas = Object.assign(document.createElement("canvas"), { width: message.width, height: message.height });
    const data = canvas.getContext("2d").createImageData(message.width, message.height);
    cells.forEach((rough, i) => {
      if (rough === 255) return;
      data.data.set([208, 96, 16, Math.min(rough / ROUGH, 1) * 200 + 20], 4 * i);
    });
    canvas.getContext("2d").putImageData(data, 0, 0);
    this.take("ground", { ...message, canvas });
  }

  takeZones({ zones }) {
    this.take("zones", zones.map((zone) => ({ ...zone, image: zone.mask && this.paintMask(zone.mask, zone.kind) })));
  }

  /** Draw a mask of runs into a canvas of its own, where it has a limit. */
  paintMask({ width, height, resolution, x, y, runs }, kind) {
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const data = canvas.getContext("2d").createImageData(width, height);
    const colour = [...rgb(this.colour[kind === "keepout" ? "bad" : "warn"]), 110];
    for (let i = 0, at = 0; i < runs.length; at += runs[i + 1], i += 2) {
      if (runs[i]) for (let j = at; j < at + runs[i + 1]; j++) data.data.set(colour, 4 * j);
    }
    canvas.getContext("2d").putImageData(data, 0, 0);
    return { canvas, origin: [x, y, 0], resolution };
  }

  setLayer(name, shown) {
    this.layers[name] = shown;
    localStorage.setItem("layers", JSON.stringify(this.layers));
    if (name === "frontiers") for (const image of [this.grid, ...this.tiles.values()]) if (image) this.paint(image);
    this.dirty = true;
  }

  /** Draw the cells of a grid into a canvas of their own, in the theme's colours. */
  paint(image) {
    const { width, height, cells } = image;
    const canvas = (image.canvas ??= Object.assign(document.createElement("canvas"), { width, height }));
    const context = canvas.getContext("2d");
    const data = context.createImageData(width, height);
    const pixels = new Uint32Array(data.data.buffer);
    const [free, wall] = [rgb(this.colour["map-free"]), rgb(this.colour["map-wall"])];
    const colours = new Uint32Array(101);
    for (let value = 0; value <= 100; value++) {
      const k = (value / 100) ** 1.8; // what is rather free looks free
      const [r, g, b] = free.map((from, i) => Math.round(from + k * (wall[i] - from)));
      colours[value] = (255 << 24) | (b << 16) | (g << 8) | r;
    }
    for (let i = 0; i < cells.length; i++) pixels[i] = cells[i] < 0 ? 0 : colours[cells[i]];
    if (this.layers.frontiers) {
      const [r, g, b] = rgb(this.colour.frontier);
      const edge = (255 << 24) | (b << 16) | (g << 8) | r;
      for (let y = 1; y < height - 1; y++) {
        for (let i = y * width + 1; i < (y + 1) * width - 1; i++) {
          if (cells[i] >= 0 && cells[i] < 40 && (cells[i - 1] < 0 || cells[i + 1] < 0 || cells[i - width] < 0 || cells[i + width] < 0)) pixels[i] = edge;
        }
      }
    }
    context.putImageData(data, 0, 0);
    return image;
  }

  // Hands

  toWorld(px, py) {
    const [dx, dy] = [(px - this.width / 2) / this.scale, -(py - this.height / 2) / this.scale];
    const [c, s] = [Math.cos(-this.rotation), Math.sin(-this.rotation)];
    return [this.centre[0] + c * dx - s * dy, this.centre[1] + s * dx + c * dy];
  }

  toScreen(x, y) {
    const [dx, dy] = [x - this.centre[0], y - this.centre[1]];
    const [c, s] = [Math.cos(this.rotation), Math.sin(this.rotation)];
    return [this.width / 2 + this.scale * (c * dx - s * dy), this.height / 2 - this.scale * (s * dx + c * dy)];
  }

  /** Index of the nearest of some places that a press there means; -1 = none. */
  nearest(places, [x, y]) {
    const distances = places.map((place) => Math.hypot(place.x - x, place.y - y));
    const least = Math.min(...distances);
    return least * this.scale <= GRASP ? distances.indexOf(least) : -1;
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (this.pointers.size > 1) this.letGo(true); // two fingers move the map
    else this.grip = this.tool;
    this.grip?.press(this.toWorld(event.offsetX, event.offsetY));
    this.dirty = true;
  }

  letGo(cancelled) {
    const { grip } = this;
    this.grip = null;
    grip?.release(cancelled);
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY];
    this.pointers.set(event.pointerId, now);
    if (this.grip) {
      this.grip.drag(this.toWorld(...now));
    } else if (this.pointers.size === 2) {
      const [a, b] = [...this.pointers.values()];
      const other = a === now ? b : a;
      const span = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      this.zoom(span(now) / Math.max(span(before), 1), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      if (!this.headingUp) {
        const angle = (p) => Math.atan2(-(p[1] - other[1]), p[0] - other[0]);
        this.headingUp = null; // turned by hand
        this.rotation += wrapped(angle(now) - angle(before));
      }
    } else {
      const [from, to] = [this.toWorld(...before), this.toWorld(...now)];
      this.setFollow(false);
      this.centre = [this.centre[0] - to[0] + from[0], this.centre[1] - to[1] + from[1]];
    }
    this.dirty = true;
  }

  release(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    this.letGo(event.type === "pointercancel");
    this.dirty = true;
  }

  key(event) {
    const step = 60 / this.scale;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (event.key in moves) {
      const [c, s] = [Math.cos(-this.rotation), Math.sin(-this.rotation)];
      const [x, y] = moves[event.key];
      this.setFollow(false);
      this.centre = [this.centre[0] + c * x - s * y, this.centre[1] + s * x + c * y];
    } else if (event.key === "+") this.zoom(1.25);
    else if (event.key === "-") this.zoom(0.8);
    else return;
    event.preventDefault();
    this.dirty = true;
  }

  setFollow(follow) {
    this.follow = follow;
    if (follow && this.pose) this.centre = this.pose.slice(0, 2);
    this.onFollow?.(follow);
    this.dirty = true;
  }

  setHeadingUp(up) {
    this.headingUp = up;
    if (this.pose) this.rotation = up ? Math.PI / 2 - this.pose[2] : 0;
    this.dirty = true;
  }

  setTool(tool) {
    this.tool = tool;
    this.canvas.classList.toggle("aiming", tool !== null);
    this.dirty = true;
  }

  zoom(by, px = this.width / 2, py = this.height / 2) {
    const fixed = this.toWorld(px, py);
    this.scale = Math.min(Math.max(this.scale * by, 4), 800);
    if (!this.follow) {
      const now = this.toWorld(px, py);
      this.centre = [this.centre[0] + fixed[0] - now[0], this.centre[1] + fixed[1] - now[1]];
    }
    this.dirty = true;
  }

  /** Show all of the map, or all that the scan sees. */
  fit() {
    const places = [];
    if (this.grid) {
      const { origin, width, height, resolution } = this.grid;
      for (const [i, j] of [[0, 0], [width, 0], [0, height], [width, height]]) places.push(compose(origin, [i * resolution, j * resolution, 0]));
    }
    for (const points of this.grid ? [] : Object.values(this.points)) for (let i = 0; i < points.length; i += 2) places.push([points[i], points[i + 1]]);
    if (this.pose) places.push(this.pose);
    if (!places.length) return;
    const [xs, ys] = [places.map((p) => p[0]), places.map((p) => p[1])];
    const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    this.setFollow(false);
    this.setHeadingUp(false);
    this.centre = [(x0 + x1) / 2, (y0 + y1) / 2];
    this.scale = Math.min(Math.max(Math.min(this.width / (x1 - x0 + 0.5), this.height / (y1 - y0 + 0.5)), 4), 800);
    this.dirty = true;
  }

  // Drawing

  draw() {
    const c = this.canvas.getContext("2d");
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = this.colour.map;
    c.fillRect(0, 0, this.width, this.height);
    c.translate(this.width / 2, this.height / 2);
    c.rotate(-this.rotation);
    c.scale(this.scale, -this.scale);
    c.translate(-this.centre[0], -this.centre[1]);
    const px = 1 / this.scale;
    if (this.grid) this.drawImage(c, this.grid);
    for (const tile of this.tiles.values()) this.drawImage(c, tile);
    if (this.ground && this.layers.ground) this.drawImage(c, this.ground);
    this.drawLines(c, px);
    if (this.layers.zones) this.drawZones(c, px);
    this.drawDocks(c, px);
    if (this.layers.trail) this.stroke(c, this.trail, this.colour.trail, 2 * px);
    if (this.path?.deformed && this.route) this.stroke(c, this.route, this.colour.route, 1.5 * px, [6 * px, 5 * px]);
    if (this.path) this.stroke(c, this.path.points, this.colour[this.path.deformed ? "deformed" : "route"], 3 * px);
    if (this.layers.scan) this.drawScan(c, px);
    this.drawGhost(c, px);
    if (this.pose) this.drawTruck(c, px);
    this.drawPast(c, px);
    this.drawFrontier(c, px);
    for (const each of this.overlays) each.draw(c, px);
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    this.drawScale(c);
  }

  drawImage(c, { canvas, origin, resolution }) {
    c.save();
    c.translate(origin[0], origin[1]);
    c.rotate(origin[2]);
    c.scale(resolution, resolution);
    c.imageSmoothingEnabled = false;
    c.drawImage(canvas, 0, 0);
    c.restore();
  }

  drawZones(c, px) {
    for (const { kind, corners, image, off_until: off, name } of this.zones) {
      c.globalAlpha = off === null ? 1 : 0.35;
      if (image) this.drawImage(c, image);
      else this.drawZone(c, px, corners, this.colour[kind === "keepout" ? "bad" : "warn"]);
      c.globalAlpha = 1;
      if (!image) this.label(c, px, ...corners[0], name);
    }
  }

  drawZone(c, px, corners, colour) {
    this.polygon(c, [0, 0, 0], corners);
    c.fillStyle = c.strokeStyle = colour;
    c.lineWidth = 2 * px;
    const alpha = c.globalAlpha;
    c.stroke();
    c.globalAlpha = 0.2 * alpha;
    c.fill("evenodd");
    c.globalAlpha = alpha;
  }

  /** Where the robot stands when it is docked, with a bar at the end that faces the dock. */
  drawDocks(c, px) {
    const { length, width } = this.shape();
    for (const [name, { pose, direction }] of Object.entries(this.link.newest.facts?.docks ?? {})) {
      const end = (direction === "reverse" ? -1 : 1) * (length / 2 + 3 * px);
      this.polygon(c, pose, outline(length, width));
      c.strokeStyle = this.colour.point;
      c.lineWidth = 1.5 * px;
      c.setLineDash([4 * px, 3 * px]);
      c.stroke();
      c.setLineDash([]);
      this.stroke(c, [compose(pose, [end, width / 2, 0]), compose(pose, [end, -width / 2, 0])], this.colour.point, 5 * px);
      this.label(c, px, pose[0], pose[1], name);
    }
  }

  drawLines(c, px) {
    const corners = [[0, 0], [this.width, 0], [0, this.height], [this.width, this.height]].map(([x, y]) => this.toWorld(x, y));
    const [xs, ys] = [corners.map((p) => p[0]), corners.map((p) => p[1])];
    const step = this.scale > 25 ? 1 : 5;
    c.beginPath();
    for (let x = Math.ceil(Math.min(...xs) / step) * step; x <= Math.max(...xs); x += step) c.moveTo(x, Math.min(...ys)), c.lineTo(x, Math.max(...ys));
    for (let y = Math.ceil(Math.min(...ys) / step) * step; y <= Math.max(...ys); y += step) c.moveTo(Math.min(...xs), y), c.lineTo(Math.max(...xs), y);
    c.strokeStyle = this.colour["map-grid"];
    c.lineWidth = px;
    c.stroke();
  }

  stroke(c, points, colour, width, dash = []) {
    if (points.length < 2) return;
    c.beginPath();
    points.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    c.strokeStyle = colour;
    c.lineWidth = width;
    c.lineJoin = "round";
    c.setLineDash(dash);
    c.stroke();
    c.setLineDash([]);
  }

  drawScan(c, px) {
    const size = Math.max(2.5 * px, 0.012);
    c.fillStyle = this.colour.scan;
    for (const [kind, points] of Object.entries(this.points)) {
      if (this.link.age(kind) > 1) continue;
      for (let i = 0; i < points.length; i += 2) c.fillRect(points[i] - size / 2, points[i + 1] - size / 2, size, size);
    }
  }

  shape() {
    const { length = 0.47, width = 0.34, wheelbase = 0.32, track = 0.26, wheel_radius = 0.075 } = this.link.newest.facts?.geometry ?? {};
    return { length, width, wheelbase, track, radius: wheel_radius };
  }

  /** Where the truck would be before it stands, if the newest heartbeat were the last: lease, link and braking. */
  drawGhost(c, px) {
    const gate = this.link.newest.gate;
    if (!gate?.twist || !this.pose || !["driving", "stopping"].includes(gate.mode)) return;
    const { vx, vy, wz } = gate.twist;
    const speed = Math.hypot(vx, vy);
    const blind = gate.mode === "driving" ? (gate.lease_left ?? 0) + (this.link.roundTrip() ?? 0) / 1000 : 0;
    const distance = gate.stopping_distance + speed * blind;
    if (speed < 0.005 || distance < 0.005) return;
    const seconds = distance / speed;
    const { length, width } = this.shape();
    for (let i = 1; i <= 4; i++) {
      this.polygon(c, moved(this.pose, [vx, vy, wz], (seconds * i) / 4), outline(length, width));
      c.globalAlpha = i === 4 ? 1 : 0.25;
      c.strokeStyle = this.colour.ghost;
      c.lineWidth = 2 * px;
      c.setLineDash([5 * px, 4 * px]);
      c.stroke();
    }
    c.setLineDash([]);
    c.globalAlpha = 1;
  }

  polygon(c, pose, corners) {
    c.beginPath();
    corners.forEach((corner, i) => {
      const [x, y] = compose(pose, [...corner, 0]);
      i ? c.lineTo(x, y) : c.moveTo(x, y);
    });
    c.closePath();
  }

  drawTruck(c, px) {
    const { length, width, wheelbase, track, radius } = this.shape();
    const old = this.link.age("pose") > 1;
    c.globalAlpha = old ? 0.4 : 1;
    this.polygon(c, this.pose, outline(length, width));
    c.fillStyle = this.colour.accent;
    c.globalAlpha *= 0.35;
    c.fill();
    c.globalAlpha = old ? 0.4 : 1;
    c.strokeStyle = this.colour.truck;
    c.lineWidth = 1.5 * px;
    c.stroke();
    const steering = this.link.newest.steering;
    const places = [[1, 1], [1, -1], [-1, 1], [-1, -1]].map(([i, j]) => [(i * wheelbase) / 2, (j * track) / 2]);
    const angles = wheelAngles(steering?.front ?? 0, steering?.rear ?? 0, wheelbase, places);
    c.fillStyle = this.colour.truck;
    places.forEach(([x, y], i) => {
      this.polygon(c, compose(this.pose, [x, y, angles[i]]), outline(2 * radius, radius * 0.8));
      c.fill();
    });
    this.polygon(c, compose(this.pose, [length / 2, 0, 0]), [[0, width / 5], [0, -width / 5], [width / 5, 0]]);
    c.fill();
    c.globalAlpha = 1;
  }

  /** Where the robot was at the time that a plot is pointed at. */
  drawPast(c, px) {
    const pose = this.cursor === null ? null : this.past.at(this.cursor);
    this.canvas.dataset.past = pose ? pose.map((value) => value.toFixed(2)) : "";
    if (pose) this.drawGoal(c, pose, px, this.colour.ghost);
  }

  drawGoal(c, pose, px, colour) {
    const { length, width } = this.shape();
    this.polygon(c, pose, outline(length, width));
    c.strokeStyle = c.fillStyle = colour;
    c.lineWidth = 2 * px;
    c.stroke();
    const size = Math.max(length / 2, 14 * px);
    this.stroke(c, [pose, compose(pose, [1.6 * size, 0, 0])], colour, 2.5 * px);
    this.polygon(c, compose(pose, [1.6 * size, 0, 0]), [[0.4 * size, 0], [-0.1 * size, 0.25 * size], [-0.1 * size, -0.25 * size]]);
    c.fill();
    c.beginPath();
    c.arc(pose[0], pose[1], 4 * px, 0, 2 * Math.PI);
    c.fill();
  }

  /** Where an exploration goes. */
  drawFrontier(c, px) {
    const { explore } = this.link.newest;
    if (this.layers.frontiers && explore?.target && explore.phase !== "idle") this.mark(c, px, explore.target.x, explore.target.y, this.colour.frontier, "");
  }

  mark(c, px, x, y, colour, label) {
    c.beginPath();
    c.arc(x, y, 7 * px, 0, 2 * Math.PI);
    c.fillStyle = colour;
    c.fill();
    if (label) this.label(c, px, x, y, label);
  }

  label(c, px, x, y, label) {
    c.save();
    c.translate(x, y);
    c.rotate(-this.rotation);
    c.scale(px, -px);
    c.font = "bold 12px system-ui, sans-serif";
    c.textAlign = "left";
    c.fillStyle = this.colour.ink;
    c.fillText(label, 10, 4);
    c.restore();
  }

  drawScale(c) {
    const metres = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20].find((m) => m * this.scale > 60) ?? 50;
    const [x, y] = [this.width - 16, this.height - 16];
    const length = metres * this.scale;
    c.fillStyle = this.colour.card;
    c.globalAlpha = 0.75;
    c.fillRect(x - length - 8, y - 24, length + 16, 32);
    c.globalAlpha = 1;
    c.strokeStyle = c.fillStyle = this.colour.ink;
    c.lineWidth = 2;
    c.beginPath();
    c.moveTo(x - length, y - 5);
    c.lineTo(x - length, y);
    c.lineTo(x, y);
    c.lineTo(x, y - 5);
    c.stroke();
    c.font = "12px system-ui, sans-serif";
    c.textAlign = "center";
    c.fillText(`${metres} m`, x - length / 2, y - 8);
  }
}

function rgb(colour) {
  const hex = colour.length === 4 ? [...colour.slice(1)].map((d) => d + d).join("") : colour.slice(1, 7);
  return [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16));
}
