// The command line that does the same as a command of the page. Pure.

const shown = (value) => String(Number(value.toFixed(3)));
const degrees = (radians) => shown((radians * 180) / Math.PI);

/** An option of a command, as a flag or with its value. */
function option([name, value]) {
  const flag = `--${name.replaceAll("_", "-")}`;
  return typeof value === "boolean" ? [value && flag] : [flag, typeof value === "number" ? shown(value) : value];
}

const LINES = {
  order: ({ order, hold }) => (order === "stop" ? null : [order, hold && order === "arm" && "--hold"]),
  goal: ({ goal: [x, y, yaw], via = [] }) => ["goto", ...via.flatMap((place) => ["--via", place.map(shown).join(",")]), "--", shown(x), shown(y), degrees(yaw)],
  start_path: ({ path }) => ["path", path],
  track_file: ({ name, closed }) => ["track", name, closed && "--closed"],
  explore: ({ order }) => ["explore", order === "stop" && "--stop"],
  mission: ({ order, moved }) => (order === "stop" ? ["mission", "stop"] : ["mission", "run", order === "start" ? "FILE" : "--resume", moved && "--moved"]),
  behave: ({ order, behaviour }) => ["behave", order, order === "start" && behaviour],
  set: ({ key, value, save }) => ["set", save && "--save", key, ...(typeof value === "number" && value < 0 ? ["--"] : []), String(value)],
  settings: () => ["get"],
  point: ({ order, name, place, yaw }) => ["points", order, name, ...(place ? ["--", ...place.map(shown), degrees(yaw)] : [])],
  zone: ({ order, name, area }) => ["zone", order, name, ...(area ? ["--", ...area.corners.map((corner) => corner.map(shown).join(","))] : [])],
  calibrate: ({ order, step, options = {} }) => (order === "start" ? ["calibrate", step.split(".")[0], ...Object.entries(options).flatMap(option)] : null),
};

/** The words of a command as a shell takes them; null where no command line does the same. */
export function commandLine(command, robot) {
  const words = LINES[command.do]?.(command)?.filter(Boolean);
  if (!words) return null;
  const [name, ...rest] = words;
  const group = ["mission", "behave", "calibrate", "points", "zone"].includes(name) ? 1 : 0;
  const named = robot && robot !== "truck" ? ["--robot", robot] : [];
  const quoted = (word) => (/^[\w.,/:@+=-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`);
  return ["monstertruckd", name, ...rest.slice(0, group), ...named, ...rest.slice(group)].map(quoted).join(" ");
}
