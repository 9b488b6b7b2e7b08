"use strict";
// One cursor for all plots, the timeline and the map: hover, touch or click an event.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const fields = [...document.querySelectorAll(".field, .lanes")];
  const cursors = [...document.querySelectorAll(".cursor")];
  const here = document.querySelector(".here");

  const nearest = (times, t) => {
    let low = 0, high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= t) low = middle; else high = middle;
    }
    return Math.abs(times[high] - t) < Math.abs(times[low] - t) ? high : low;
  };

  const text = (value) => value.toFixed(Math.abs(value) >= 100 ? 1 : Math.abs(value) >= 10 ? 2 : 3).replace("-", "\u2212");

  const show = (share) => {
    const t = Math.min(Math.max(share, 0), 1) * data.milliseconds;
    for (const cursor of cursors) {
      cursor.style.display = "block";
      cursor.style.left = `${100 * t / data.milliseconds}%`;
    }
    document.querySelectorAll(".plot").forEach((plot) => {
      const lines = data.plots[plot.dataset.plot];
      plot.querySelectorAll("output").forEach((output, n) => {
        const [times, values] = lines[n];
        const i = nearest(times, t);
        output.textContent = times.length && Math.abs(times[i] - t) < data.milliseconds / 50 + 2000 ? text(values[i]) : "";
      });
    });
    if (here && data.way[0].length) {
      const i = nearest(data.way[0], t);
      here.setAttribute("cx", data.way[1][i]);
      here.setAttribute("cy", -data.way[2][i]);
      here.style.display = "inline";
    }
  };

  for (const field of fields) {
    field.addEventListener("pointermove", (event) => {
      const box = field.getBoundingClientRect();
      show((event.clientX - box.left) / box.width);
    });
  }
  for (const row of document.querySelectorAll("[data-at]")) {
    row.addEventListener("click", () => show(row.dataset.at / data.milliseconds));
  }
})();
