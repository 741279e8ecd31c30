// How errors and feature distances are spread, and how precision depends on dimension and radius; linked to the scene.

import { element, label, vector } from "../lib/dom.js";
import { axisUnit, count, length, percent, significant } from "../lib/format.js";
import { axes, interpolate, lengthAxis, linePath, roundValues, shareAxis } from "../lib/plot.js";
import { listen } from "../server.js";

const SWEEPS = ["dim", "radius"];

let page;
let plots = null;
let isFetching = false;
let asked = null; // for which matches the dimensions were asked for
const boxes = {};

export function mount(root, given) {
  page = given;
  const grid = element("div", { className: "plots-grid" },
    box("curve", "Precision", "Share of right matches over the error accepted"),
    box("errors", "Errors", "Matches by their error"),
    box("distances", "Distances", "Right and wrong matches by the distance of their features"),
    box("dim", "Over dimensions", "Precision over the dimensions of the feature"),
    box("radius", "Over radii", "Precision over the support radius"));
  root.append(grid);
  listenToCurve();
  const compute = element("button", { type: "button", className: "small", textContent: "Compute" });
  compute.onclick = () => {
    if (taskOf("radius")) page.api("tasks/radius", { method: "DELETE" });
    else sweep("radius");
  };
  boxes.radius.button = compute;
  boxes.radius.note.after(compute);
  page.command("clear-bar", { label: "Show the matches of all bars again", run: () => page.change({ bar: null }) });
  page.command("sweep-radius", { label: "Compute precision over radii", run: () => { page.open("plots"); sweep("radius"); } });
  listen(() => renderTasks());
  new ResizeObserver(() => page.state() && draw(page.state())).observe(grid);
}

function box(name, title, text) {
  const note = element("small");
  const svg = vector("svg", { class: "plot", role: "group", "aria-label": text, id: `plot-${name}` });
  const root = element("div", { className: `panel plot-${name}` }, element("h2", { textContent: `${title} ` }, note), svg);
  boxes[name] = { root, note, svg };
  return root;
}

export function render(state) {
  draw(state);
  if (plots?.revision !== state.revision) fetchPlots();
}

async function fetchPlots() {
  if (isFetching) return;
  isFetching = true;
  try {
    plots = await page.api("plots");
  } catch {
    plots = null;
  } finally {
    isFetching = false;
  }
  const state = page.state();
  draw(state);
  if (plots && plots.revision < state.revision) fetchPlots();
  askForDims(state);
}

/** All dimensions are prefixes of the features that are there, so their precision comes without being asked for. */
function askForDims({ status, settings }) {
  const { pair, descriptor, support_radius, lrf_radius, voxel_size, model } = settings;
  const key = JSON.stringify([pair, descriptor, support_radius, lrf_radius, voxel_size, model]);
  if (!plots || status.phase !== "ready" || asked === key || plots.dims.points.every(({ precision }) => precision !== null)) return;
  asked = key;
  sweep("dim");
}

async function sweep(name) {
  try {
    await page.api(`sweeps/${name}`, { method: "POST" });
  } catch (error) {
    page.refuse(error.message);
  }
}

const taskOf = (kind) => page.state()?.status.tasks?.find((task) => task.kind === kind);

function draw(state) {
  drawCurve(state);
  for (const name of ["errors", "distances", "dim", "radius"]) boxes[name].svg.replaceChildren();
  if (!plots) return;
  drawErrors(state);
  drawDistances(state);
  drawSweep("dim", plots.dims, state);
  drawSweep("radius", plots.radii, state);
  renderTasks();
}

// ---------------------------------------------------------------- the threshold

function drawCurve({ curve, numbers, unit }) {
  const { svg, note } = boxes.curve;
  note.textContent = "";
  const last = curve?.thresholds.at(-1);
  const plot = curve && axes(svg, { x: lengthAxis(last, unit, "error accepted"), y: shareAxis("right matches") });
  boxes.curve.plot = plot;
  if (!plot) {
    svg.replaceChildren();
    return;
  }
  const { x, y, box: area, parts } = plot;
  const line = linePath(plot, curve.thresholds, curve.precision);
  const near = Math.min(page.chosen().right_within ?? numbers.precision_radius, last);
  const share = interpolate(curve.thresholds, curve.precision, near);
  parts.push(vector("path", { class: "fill", d: `${line}L${x(last)} ${area.bottom}L${area.left} ${area.bottom}Z` }));
  parts.push(vector("path", { class: "line", d: line }));
  const cursor = vector("g", { class: "cursor", tabindex: 0, role: "slider", id: "threshold", "aria-label": "Error up to which a match is right",
    "aria-valuemin": 0, "aria-valuemax": last, "aria-valuenow": near, "aria-valuetext": length(near, unit) },
  vector("rect", { class: "grip", x: x(near) - 9, y: area.top, width: 18, height: area.bottom - area.top }),
  vector("line", { x1: x(near), x2: x(near), y1: area.top, y2: area.bottom }),
  vector("circle", { cx: x(near), cy: y(share), r: 4 }));
  cursor.addEventListener("keydown", (event) => {
    const steps = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 5, PageDown: -5 }[event.key];
    if (event.key === "Home" || event.key === "Delete") setThreshold(null);
    else if (steps) setThreshold(Math.min(Math.max(near + (steps * last) / 50, last / 50), last));
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  const hadFocus = document.activeElement?.id === "threshold";
  parts.push(cursor);
  svg.replaceChildren(...parts);
  if (hadFocus) cursor.focus();
  note.textContent = `${percent(share)} within ${length(near, unit)}`;
  note.title = `Of ${count(curve.count)} matches with a true partner. Drag the line; double-click puts it back.`;
}

function setThreshold(value) {
  page.change({ right_within: value === null ? null : Number(value.toPrecision(3)) });
  draw(page.state());
}

/** The threshold follows the pointer while it is down. */
function listenToCurve() {
  const { svg } = boxes.curve;
  const read = (event) => {
    const { plot } = boxes.curve;
    const last = page.state()?.curve?.thresholds.at(-1);
    if (plot && last) setThreshold(Math.max(plot.xAt(event.clientX - svg.getBoundingClientRect().x), last / 100));
  };
  svg.addEventListener("pointerdown", (event) => {
    svg.setPointerCapture(event.pointerId);
    read(event);
    svg.addEventListener("pointermove", read);
    svg.addEventListener("lostpointercapture", () => svg.removeEventListener("pointermove", read), { once: true });
  });
  svg.addEventListener("dblclick", () => setThreshold(null));
}

// ---------------------------------------------------------------- histograms

const countAxis = (highest, what) => {
  const ticks = roundValues(0, highest, 3);
  return { range: [0, Math.max(highest, 1)], title: what, grid: ticks, ticks: ticks.map((value) => [value, value < 10000 ? String(value) : `${value / 1000}k`]) };
};

/** Counts of one kind upwards, of the other downwards. */
function mirroredAxis(up, down) {
  const ticks = roundValues(-Math.max(down, 1), Math.max(up, 1), 4);
  return { range: [-Math.max(down, 1), Math.max(up, 1)], title: "matches", grid: ticks, ticks: ticks.map((value) => [value, String(Math.abs(value))]) };
}

function isChosen(kind, low, high) {
  const bar = page.chosen().bar;
  return bar !== null && bar !== undefined && bar.kind === kind && Math.abs(bar.low - low) < 1e-9 && Math.abs(bar.high - high) < 1e-9;
}

/** A bar that leaves only its matches in the scene, and brings all back when it is chosen again. */
function barOf(plot, kind, edges, index, columns, text) {
  const [low, high] = [edges[index], edges[index + 1]];
  const [left, right] = [plot.x(low), plot.x(high)];
  const chosen = isChosen(kind, low, high);
  const toggle = () => page.change({ bar: chosen ? null : { kind, low, high } });
  const group = vector("g", { class: chosen ? "bar chosen" : "bar", role: "button", tabindex: 0, "aria-pressed": String(chosen), "aria-label": text, "data-bar": `${kind}-${index}` });
  group.append(vector("title", {}, text), vector("rect", { class: "hit", x: left, y: plot.box.top, width: right - left, height: plot.box.bottom - plot.box.top }));
  for (const { value, className, fill } of columns) {
    const [top, bottom] = [plot.y(Math.max(value, 0)), plot.y(Math.min(value, 0))];
    group.append(vector("rect", { class: className, x: left + 0.5, y: top, width: Math.max(right - left - 1, 0.5), height: bottom - top, ...(fill && { fill }) }));
  }
  group.addEventListener("click", toggle);
  group.addEventListener("keydown", (event) => {
    const next = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (event.key === "Enter" || event.key === " ") toggle();
    else if (next) group.parentElement.querySelector(`[data-bar="${kind}-${index + next}"]`)?.focus();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  return group;
}

/** Fill a plot anew; the bar that has the focus keeps it. */
function fill(svg, parts) {
  const focused = document.activeElement?.dataset?.bar;
  svg.replaceChildren(...parts);
  if (focused) svg.querySelector(`[data-bar="${focused}"]`)?.focus();
}

function drawErrors({ unit }) {
  const { svg, note } = boxes.errors;
  const bars = plots.error_bars;
  note.textContent = bars ? `${count(bars.beyond)} beyond` : "no pose to judge by";
  const plot = bars && axes(svg, { x: lengthAxis(bars.edges.at(-1), unit, "error"), y: countAxis(Math.max(...bars.counts), "matches"), left: 42 });
  if (!plot) return;
  const near = plot.x(Math.min(plots.right_within, bars.edges.at(-1)));
  fill(svg, [...plot.parts,
    ...bars.counts.map((value, index) => barOf(plot, "error", bars.edges, index, [{ value, className: "column", fill: bars.colors[index] }],
      `${count(value)} matches with an error of ${length(bars.edges[index], unit)} to ${length(bars.edges[index + 1], unit)}`)),
    vector("line", { class: "mark", x1: near, x2: near, y1: plot.box.top, y2: plot.box.bottom })]);
}

function drawDistances() {
  const { svg, note } = boxes.distances;
  const bars = plots.distance_bars;
  note.textContent = !bars || bars.separation === null ? "" : `separation ${percent(bars.separation, 0)}`;
  note.title = "How often a right match drawn at random has a smaller feature distance than a wrong one: 50 % tells nothing";
  const last = bars?.edges.at(-1);
  const plot = bars && axes(svg, {
    x: { range: [0, last], title: "feature distance", ticks: roundValues(0, last, 5).map((value) => [value, significant(value, 3)]) },
    y: bars && mirroredAxis(Math.max(...bars.right), Math.max(...bars.wrong)), left: 42,
  });
  if (!plot) return;
  const legend = (at, className, text) => [
    vector("rect", { class: className, x: plot.box.right - 42, y: at - 8, width: 9, height: 9 }),
    label(plot.box.right - 29, at, text, "start"),
  ];
  fill(svg, [...plot.parts,
    ...bars.right.map((right, index) => barOf(plot, "distance", bars.edges, index,
      [{ value: right, className: "right" }, { value: -bars.wrong[index], className: "wrong" }],
      `${count(right)} right and ${count(bars.wrong[index])} wrong matches at ${significant(bars.edges[index], 3)} to ${significant(bars.edges[index + 1], 3)}`)),
    ...legend(plot.box.top + 10, "right", "right"), ...legend(plot.box.bottom - 4, "wrong", "wrong")]);
}

// ---------------------------------------------------------------- precision over a setting

function drawSweep(name, sweep, { unit }) {
  const { svg } = boxes[name];
  const known = sweep.points.filter(({ precision }) => precision !== null);
  const values = sweep.points.map(({ value }) => value);
  if (!values.length) return;
  const { size, name: unitName } = axisUnit(values.at(-1), unit);
  const write = (value) => (name === "radius" ? significant(value / size, 2) : String(value));
  const wide = values.length > 1 ? [values[0] / 1.12, values.at(-1) * 1.12] : [values[0] / 2, values[0] * 2];
  const plot = axes(svg, {
    x: { range: wide, log: true, title: name === "radius" ? `radius (${unitName})` : "dimensions", ticks: thinned(values, wide, svg).map((value) => [value, write(value)]) },
    y: shareAxis("right matches"),
  });
  if (!plot) return;
  const parts = [...plot.parts, vector("path", { class: "line", d: linePath(plot, known.map(({ value }) => value), known.map(({ precision }) => precision)) })];
  for (const { value, precision } of sweep.points) {
    const isCurrent = Math.abs(value - sweep.current) < 1e-9 * value;
    const text = `${name === "radius" ? `Radius ${length(value, unit, 3)}` : `${value} dimensions`}: ${precision === null ? "not computed yet" : percent(precision)}`;
    const [x, y] = [plot.x(value), plot.y(precision ?? 0)];
    const point = vector("g", { class: `point${isCurrent ? " current" : ""}${precision === null ? " unknown" : ""}`, role: "button", tabindex: 0, "aria-label": `${text}; take it`, "data-bar": `${name}-${value}` },
      vector("title", {}, text), vector("circle", { class: "hit", cx: x, cy: y, r: 11 }), vector("circle", { class: "dot", cx: x, cy: y, r: isCurrent ? 5 : 4 }));
    const take = () => page.change(name === "radius" ? { support_radius: value } : { dim: value });
    point.addEventListener("click", take);
    point.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      event.stopPropagation();
      take();
    });
    parts.push(point);
    if (isCurrent && precision !== null) parts.push(label(x, y > plot.box.top + 22 ? y - 10 : y + 18, percent(precision, 0), "middle", "value"));
  }
  fill(svg, parts);
}

/** The values whose labels do not run into each other, the last one included. */
function thinned(values, [low, high], svg) {
  const pixels = svg.getBoundingClientRect().width - 44;
  const at = (value) => (pixels * Math.log(value / low)) / Math.log(high / low);
  const kept = [];
  for (const value of [...values].reverse()) if (!kept.length || at(kept.at(-1)) - at(value) > 26) kept.push(value);
  return kept;
}

function renderTasks() {
  for (const name of SWEEPS) {
    const task = taskOf(name);
    boxes[name].note.textContent = task ? `${Math.round(100 * task.progress)} %` : "";
  }
  const task = taskOf("radius");
  const missing = plots?.radii.points.some(({ precision }) => precision === null);
  boxes.radius.button.textContent = task ? "Stop" : "Compute";
  boxes.radius.button.hidden = !task && !missing;
}
