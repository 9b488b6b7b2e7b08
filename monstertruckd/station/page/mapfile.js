// The shown map as the two files of map_server: an image (PGM) and its description (YAML).
import { byId, element } from "./dom.js";

const IMAGE = "map.pgm";
const [FREE, UNKNOWN, OCCUPIED] = [254, 205, 0]; // grey values of map_server
const [FREE_BELOW, OCCUPIED_FROM] = [0.196, 0.65];

/**
 * @typedef {object} Cells
 * @property {number} width
 * @property {number} height
 * @property {number} resolution
 * @property {number[]} origin
 * @property {ArrayLike<number>} cells percent, -1 = unknown; row 0 at the lowest y
 */

/**
 * A grid with its newer tiles as the bytes of a PGM file, whose first row is the highest y.
 *
 * @param {Cells} grid
 * @param {Iterable<Cells>} tiles
 */
export function mapImage(grid, tiles) {
  const { width, height } = grid;
  const head = new TextEncoder().encode(`P5\n${width} ${height}\n255\n`);
  const image = new Uint8Array(head.length + width * height);
  image.set(head);
  for (const part of [grid, ...tiles]) {
    const [left, low] = [0, 1].map((axis) => Math.round((part.origin[axis] - grid.origin[axis]) / grid.resolution));
    for (let row = Math.max(0, -low); row < Math.min(part.height, height - low); row++) {
      for (let column = Math.max(0, -left); column < Math.min(part.width, width - left); column++) {
        const share = part.cells[row * part.width + column] / 100;
        image[head.length + (height - 1 - low - row) * width + left + column] = share < 0 ? UNKNOWN : share < FREE_BELOW ? FREE : share >= OCCUPIED_FROM ? OCCUPIED : UNKNOWN;
      }
    }
  }
  return image;
}

/** @param {Cells} grid */
export function mapText({ resolution, origin }) {
  const rows = { image: IMAGE, mode: "trinary", resolution, origin: `[${origin.join(", ")}]`, negate: 0, occupied_thresh: OCCUPIED_FROM, free_thresh: FREE_BELOW };
  return Object.entries(rows).map(([key, value]) => `${key}: ${value}\n`).join("");
}

/**
 * Let buttons give the map to the browser: both files are of the map at the first press, as the grid may grow.
 *
 * @param {import("./socket.js").Link} link
 * @param {{grid: Cells | null, tiles: Map<string, Cells>}} map
 */
export function watchMapFiles(link, map) {
  link.on("map", () => { byId("task-map").hidden = false; });
  let half = null; // the map of which one file was given, and which one
  link.on("robot", () => { byId("task-map").hidden = true; half = null; });
  const offer = (id, name, content) => {
    byId(id).textContent = name;
    byId(id).onclick = () => {
      if (!map.grid) return;
      const other = half && half.id !== id ? half : null;
      const { grid, tiles } = other ?? { grid: map.grid, tiles: [...map.tiles.values()] };
      half = other ? null : { id, grid, tiles };
      give(name, content(grid, tiles));
    };
  };
  offer("map-image", IMAGE, mapImage);
  offer("map-text", "map.yaml", mapText);
}

/**
 * Save a file in the browser.
 *
 * @param {string} name
 * @param {BlobPart} content
 */
export function give(name, content) {
  const url = URL.createObjectURL(new Blob([content], { type: "application/octet-stream" }));
  element("a", { href: url, download: name }).click();
  URL.revokeObjectURL(url);
}
