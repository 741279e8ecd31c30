// How many matches are right, how that depends on what counts as right, and where points are lost on the way.

import { element, label, pairs, vector } from "../lib/dom.js";
import { count, length, percent } from "../lib/format.js";
import { axes, interpolate, keepInside, lengthAxis, linePath, shareAxis } from "../lib/plot.js";

const headline = element("strong", { id: "precision", textContent: "–" });
const headlineLabel = element("span", { id: "precision-label", textContent: "waiting for matches" });
const figures = element("dl", { id: "figures" });
const note = element("small", { id: "curve-note" });
const svg = vector("svg", { id: "curve", class: "plot", role: "img", "aria-label": "Share of right matches over the error accepted" });
const funnel = element("ol", { id: "funnel" });

let shown = null;
let curve = null;
let curveBefore = null;

export function mount(root) {
  root.append(
    element("div", { className: "panel figures" }, element("h2", { textContent: "Right matches" }),
      element("p", { className: "headline" }, headline, headlineLabel), figures),
    element("div", { className: "panel curve" }, element("h2", { textContent: "Precision " }, note), svg),
    element("div", { className: "panel funnel" }, element("h2", { textContent: "Points to right matches" }), funnel),
  );
  svg.addEventListener("pointermove", (event) => shown?.curve && renderCurve(shown, event.offsetX));
  svg.addEventListener("pointerleave", () => shown?.curve && renderCurve(shown));
  new ResizeObserver(() => shown && renderCurve(shown)).observe(svg);
}

/** Keep the curve before the last change, for comparison. */
export function observe(next) {
  const samePair = shown && shown.settings.pair === next.settings.pair;
  const key = JSON.stringify(next.curve);
  if (next.curve && (!curve || curve.key !== key)) {
    curveBefore = samePair && curve && curve.scale === next.legend?.scale ? curve.value : null;
    curve = { key, value: next.curve, scale: next.legend?.scale };
  } else if (!next.curve && !samePair) {
    curve = curveBefore = null;
  }
  shown = next;
}

export function render(state) {
  renderFigures(state);
  renderCurve(state);
  renderFunnel(state);
}

function renderFigures({ numbers, estimate, source, target, status, unit }) {
  headline.textContent = numbers ? percent(numbers.precision) : "–";
  headlineLabel.textContent = numbers
    ? `within ${length(numbers.precision_radius, unit)}`
    : status.phase === "working" ? "waiting for matches" : "no pose to judge by";
  const features = (cloud) => (cloud.features === null ? "–" : count(cloud.features));
  pairs(figures, [
    ["Matches", numbers ? count(numbers.matches) : "–"],
    ["Inlier ratio", numbers ? percent(numbers.inlier_ratio) : "–"],
    ["Median error", numbers ? length(numbers.median_error, unit) : "–"],
    ["Points", `${count(source.points)} → ${count(target.points)}`],
    ["Features", `${features(source)} → ${features(target)}`],
    [estimate?.rotation_error_deg === null || !estimate ? "Estimate" : "Estimate error", describeEstimate(estimate, unit)],
  ]);
}

function describeEstimate(estimate, unit) {
  if (!estimate) return "–";
  if (!estimate.found) return "none found";
  if (estimate.rotation_error_deg !== null) {
    return `${estimate.rotation_error_deg.toFixed(1)}°, ${length(estimate.translation_error, unit)}`;
  }
  return estimate.given ? "as given" : `${percent(estimate.fitness, 0)} of points fit`;
}

function renderFunnel({ funnel: steps, numbers, unit }) {
  const largest = Math.max(1, ...steps.map((step) => step.count));
  const bar = (part, className) => {
    const made = element("i", { className });
    made.style.width = `${(100 * part) / largest}%`;
    return made;
  };
  funnel.replaceChildren(...steps.map(({ name, count: left, right, precision }) => {
    const isJudged = right !== null;
    const title = isJudged && numbers
      ? `${name}: ${count(left)} points; ${count(right)} of their matches, ${percent(precision)}, are right within ${length(numbers.precision_radius, unit)}`
      : `${name}: ${count(left)}`;
    return element("li", { title }, bar(left, "left"), ...(isJudged ? [bar(right, "right")] : []),
      element("span", { textContent: name }),
      ...(isJudged ? [element("small", { textContent: percent(precision) })] : []), element("b", { textContent: count(left) }));
  }));
}

function renderCurve({ curve: points, numbers, unit }, pointer = null) {
  note.textContent = points ? `of ${count(points.count)} with a true partner` : "";
  const last = points?.thresholds.at(-1);
  const plot = points && axes(svg, { x: lengthAxis(last, unit, "error accepted"), y: shareAxis("right matches") });
  if (!plot) {
    svg.replaceChildren();
    return;
  }
  const { thresholds, precision } = points;
  const { x, y, box, parts } = plot;
  const line = linePath(plot, thresholds, precision);
  if (curveBefore) parts.push(vector("path", { class: "before", d: linePath(plot, curveBefore.thresholds, curveBefore.precision) }));
  parts.push(vector("path", { class: "fill", d: `${line}L${x(last)} ${box.bottom}L${box.left} ${box.bottom}Z` }));
  parts.push(vector("path", { class: "line", d: line }));
  const read = pointer === null ? Math.min(numbers?.precision_radius ?? last, last) : plot.xAt(pointer);
  const share = interpolate(thresholds, precision, read);
  parts.push(vector("line", { class: "mark", x1: x(read), x2: x(read), y1: box.top, y2: box.bottom }));
  parts.push(vector("circle", { cx: x(read), cy: y(share), r: 3.5 }));
  const text = label(x(read) + 7, y(share) + (share < 0.2 ? -9 : 18), `${percent(share)} within ${length(read, unit)}`, "start", "value");
  parts.push(text);
  svg.replaceChildren(...parts);
  keepInside(text, plot);
}
