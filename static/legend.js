// The legend, painted with the colours that the server painted the scene with.

import { $, element } from "./lib/dom.js";
import { rampMarks } from "./lib/plot.js";

export function renderLegend({ legend, reference, unit }) {
  const against = legend.coloring === "error" && reference === "estimate" ? ", relative to the estimate" : "";
  $("legend-title").textContent = legend.title + against;
  $("legend-title").title = legend.title + against;
  // First, as they take room from the ramp.
  $("swatches").replaceChildren(...legend.swatches.map(({ color, label }) => {
    const dot = element("i");
    dot.style.background = color;
    return element("li", { title: label }, dot, label);
  }));
  $("ramp").hidden = legend.ramp.length === 0;
  if (legend.ramp.length) {
    const canvas = $("ramp-colors");
    canvas.width = legend.ramp.length;
    const context = canvas.getContext("2d");
    legend.ramp.forEach((color, column) => {
      context.fillStyle = color;
      context.fillRect(column, 0, 1, 1);
    });
    $("ramp-ticks").replaceChildren(...rampMarks(legend, unit).map(([at, text]) => {
      const tick = element("span", { textContent: text });
      tick.style.left = `${100 * at}%`;
      return tick;
    }));
    thinTicks();
  }
}

/** Drop the labels that the last one, or the one before, leaves no room for. */
function thinTicks() {
  const ticks = [...$("ramp-ticks").children];
  const last = ticks.pop();
  let end = -Infinity;
  for (const tick of ticks) {
    const { left, right } = tick.getBoundingClientRect();
    if (left < end || right + 8 > last.getBoundingClientRect().left) tick.remove();
    else end = right + 8;
  }
}
