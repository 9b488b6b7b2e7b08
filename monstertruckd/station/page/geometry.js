// Plane geometry of the robot: x forward, y left, angles counter-clockwise, metres and radians.

/**
 * x, y and angle.
 *
 * @typedef {number[]} Pose
 */

/**
 * A pose given in the frame of another one, in that one's frame.
 *
 * @param {Pose} frame
 * @param {Pose} pose
 * @returns {Pose}
 */
export const compose = ([x, y, a], [px, py, pa]) => [
  x + Math.cos(a) * px - Math.sin(a) * py,
  y + Math.sin(a) * px + Math.cos(a) * py,
  a + pa,
];

export const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

/**
 * Pose after a constant twist (vx, vy, wz) for some seconds.
 *
 * @param {Pose} pose
 * @param {number[]} twist
 * @param {number} seconds
 */
export function moved(pose, [vx, vy, wz], seconds) {
  const turn = wz * seconds;
  if (Math.abs(turn) < 1e-6) return compose(pose, [vx * seconds, vy * seconds, turn]);
  const s = Math.sin(turn) / wz;
  const c = (1 - Math.cos(turn)) / wz;
  return compose(pose, [vx * s - vy * c, vx * c + vy * s, turn]);
}

/** Angles of the wheels at (x, y) rows, of a bicycle with these axle angles and this wheelbase. */
export function wheelAngles(front, rear, wheelbase, places) {
  const difference = Math.tan(front) - Math.tan(rear);
  if (Math.abs(difference) < 1e-4) return places.map(() => (front + rear) / 2);
  const y = wheelbase / difference;
  const x = -wheelbase / 2 - y * Math.tan(rear);
  return places.map(([px, py]) => Math.atan(-(x - px) / (y - py)));
}

export function outline(length, width) {
  const [l, w] = [length / 2, width / 2];
  return [[l, w], [-l, w], [-l, -w], [l, -w]];
}

/**
 * Pose in the frame of another pose.
 *
 * @param {Pose} frame
 * @param {Pose} pose
 * @returns {Pose}
 */
export function relative([x, y, a], [px, py, pa]) {
  const [dx, dy] = [px - x, py - y];
  return [Math.cos(a) * dx + Math.sin(a) * dy, Math.cos(a) * dy - Math.sin(a) * dx, wrapped(pa - a)];
}

/**
 * A vector turned by a quaternion (x, y, z, w).
 *
 * @param {number[]} quaternion
 * @param {number[]} vector
 */
export function turned([qx, qy, qz, qw], [x, y, z]) {
  const [tx, ty, tz] = [2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)];
  return [x + qw * tx + qy * tz - qz * ty, y + qw * ty + qz * tx - qx * tz, z + qw * tz + qx * ty - qy * tx];
}

const NEAREST = 0.05; // metres before the lens from which on a point is drawn

/**
 * Where a point is in a camera's picture, as shares of its width and height; null behind the lens and far outside.
 *
 * @param {number[]} point x, y, z in base
 * @param {{translation: number[], rotation: number[]}} mount of the camera in base: x forward, y left, z up
 * @param {any} lens as the robot's configuration has it: a pinhole with Brown's distortion
 */
export function projected(point, { translation, rotation }, lens) {
  const [qx, qy, qz, qw] = rotation;
  const [ahead, left, up] = turned([-qx, -qy, -qz, qw], point.map((value, i) => value - translation[i]));
  if (ahead < NEAREST) return null;
  const [x, y] = [-left / ahead, -up / ahead];
  const r = x * x + y * y;
  if (r > 9) return null; // the polynomial of the distortion holds within the picture
  const radial = 1 + r * (lens.k1 + r * (lens.k2 + r * lens.k3));
  const u = x * radial + 2 * lens.p1 * x * y + lens.p2 * (r + 2 * x * x);
  const v = y * radial + lens.p1 * (r + 2 * y * y) + 2 * lens.p2 * x * y;
  return [(lens.centre_x + 0.5 + lens.focal_x * u) / lens.width, (lens.centre_y + 0.5 + lens.focal_y * v) / lens.height];
}
