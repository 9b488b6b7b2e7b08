// Plane geometry of the robot: x forward, y left, angles counter-clockwise, metres and radians.

export const compose = ([x, y, a], [px, py, pa]) => [
  x + Math.cos(a) * px - Math.sin(a) * py,
  y + Math.sin(a) * px + Math.cos(a) * py,
  a + pa,
];

export const wrapped = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

/** Pose after a constant twist (vx, vy, wz) for some seconds. */
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
