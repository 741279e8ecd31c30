// Plots as SVG: scales, axes and what is drawn along them.

import { label, vector } from "./dom.js";
import { axisUnit, length, significant } from "./format.js";

/** Round values from `low` to `high`, about `wanted` of them. */
export function roundValues(low, high, wanted = 6) {
  const span = high - low;
  if (!(span > 0)) return [low];
  const magnitude = 10 ** Math.floor(Math.log10(span));
  const step = [0.1, 0.2, 0.5, 1, 2, 5].map((share) => share * magnitude).find((candidate) => span / candidate <= wanted);
  const values = [];
  for (let value = Math.ceil(low / step - 1e-9) * step; value <= high + span * 1e-4; value += step) {
    values.push(Number(value.toPrecision(6)));
  }
  return values;
}

/** Marks along the ramp of a legend, at shares of its width; errors leave the last `room` of it to what is beyond. */
export function rampMarks({ ticks, scale }, unit, { wanted = 6, room = 0 } = {}) {
  if (ticks.length) return ticks.map(({ at, label: text }) => [at, text]);
  const { size } = axisUnit(scale, unit);
  const inside = roundValues(0, scale / size, wanted).filter((value) => value * size < (1 - room) * scale);
  return [...inside.map((value) => [(value * size) / scale, significant(value, 3)]), [1, `≥ ${length(scale, unit)}`]];
}

/** An axis of lengths from 0 to `last`, in the unit that suits them: its ticks are pairs of value and text. */
export function lengthAxis(last, unit, what) {
  const { name, size } = axisUnit(last, unit);
  return {
    range: [0, last], title: `${what} (${name})`,
    ticks: roundValues(0, last / size).map((value) => [value * size, significant(value, 3)]),
  };
}

/** An axis of shares from 0 to 1 in percent. */
export const shareAxis = (what) => ({
  range: [0, 1], title: `${what} (%)`, grid: [0, 0.25, 0.5, 0.75, 1], ticks: [0, 0.5, 1].map((share) => [share, `${100 * share}`]),
});

/**
 * Scales and axes of a plot that fills `svg`; null while it has no size.
 *
 * An axis has a `range`, a `title`, `ticks` (pairs of value and text), and may have a `grid` (values) and be `log`.
 * Gives `x` and `y` from values to pixels, `xAt` back from a pixel, the `box` inside the axes, and `parts` to draw first.
 */
export function axes(svg, { x, y, left = 34, bottom = 32 }) {
  const { width, height } = svg.getBoundingClientRect();
  if (width < left + 20 || height < bottom + 20) return null;
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const box = { left, right: width - 10, top: 8, bottom: height - bottom };
  const share = ({ range: [low, high], log }, value) =>
    (log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low));
  const atX = (value) => box.left + (box.right - box.left) * share(x, value);
  const atY = (value) => box.bottom - (box.bottom - box.top) * share(y, value);
  const parts = [];
  for (const value of y.grid ?? []) {
    parts.push(vector("line", { class: "grid", x1: box.left, x2: box.right, y1: atY(value), y2: atY(value) }));
  }
  for (const [value, text] of y.ticks) parts.push(label(box.left - 5, atY(value) + 4, text, "end"));
  for (const [value, text] of x.ticks) parts.push(label(atX(value), box.bottom + 14, text, "middle"));
  parts.push(label((box.left + box.right) / 2, height - 3, x.title, "middle"));
  // About 6 pixels a letter; a title longer than its axis would run into the numbers.
  if (y.title && 6 * y.title.length < box.bottom - box.top) {
    const side = label(0, 0, y.title, "middle");
    side.setAttribute("transform", `translate(9 ${(box.top + box.bottom) / 2}) rotate(-90)`);
    parts.push(side);
  }
  const xAt = (pixel) => {
    const along = Math.min(Math.max((pixel - box.left) / (box.right - box.left), 0), 1);
    const [low, high] = x.range;
    return x.log ? low * (high / low) ** along : low + (high - low) * along;
  };
  return { x: atX, y: atY, xAt, box, parts };
}

/** The path through `xs` and `ys`, in the values of the plot's scales. */
export const linePath = (plot, xs, ys) =>
  xs.map((value, index) => `${index ? "L" : "M"}${plot.x(value).toFixed(1)} ${plot.y(ys[index]).toFixed(1)}`).join("");

/** The value at `at` of a curve whose `xs` are evenly spaced from 0. */
export function interpolate(xs, ys, at) {
  const position = (at / xs.at(-1)) * (xs.length - 1);
  const index = Math.min(Math.floor(position), xs.length - 2);
  return ys[index] + (ys[index + 1] - ys[index]) * (position - index);
}

/** Move a text that reaches beyond the plot's right edge back inside; it must be in the document. */
export function keepInside(text, plot) {
  const { x, width } = text.getBBox();
  const over = x + width - plot.box.right;
  if (over > 0) text.setAttribute("x", Number(text.getAttribute("x")) - over);
}
