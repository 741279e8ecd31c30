// Fills a report from the data that it carries.

const data = JSON.parse($("data").textContent);
const { results, scene } = data;
const { unit, numbers, curve, estimate } = results;

const NAMES = {
  error: "Error", features: "Features", original: "Original", loaded: "Loaded", ground_truth: "Truth", estimate: "Estimate",
  side_by_side: "Side by side", overlaid: "Overlaid", min_radius: "Minimum radius", lrf_radius: "Frame radius", tau: "True partner within",
  precision_radius: "Right within", inlier_distance: "Inliers within", "ransac+icp": "RANSAC, then ICP",
};
const named = (name) => NAMES[name] ?? name.replaceAll("_", " ").replace(/^./, (letter) => letter.toUpperCase());

// ---------------------------------------------------------------- scene

const drawn = makeScene($("scene"), scene);
const shown = { coloring: scene.coloring, pose: scene.pose, layout: scene.layout, lines: "Lines" };

function choice(name, values, apply) {
  const group = element("div", { className: "choice", role: "radiogroup", ariaLabel: named(name) });
  group.append(...values.map((value) => {
    const input = element("input", { type: "radio", name, value, checked: shown[name] === value });
    input.onchange = () => {
      shown[name] = value;
      apply();
    };
    return element("label", {}, input, element("span", { textContent: named(value) }));
  }));
  return group;
}

function show() {
  drawn.color(shown.coloring);
  drawn.lines(shown.lines === "Lines");
  renderLegend(data.legends[shown.coloring]);
}

if (drawn) {
  const move = () => drawn.move(shown.pose, shown.layout);
  $("choices").append(
    choice("coloring", Object.keys(scene.colors), show), choice("layout", ["side_by_side", "overlaid"], move),
    choice("pose", Object.keys(scene.places), move), choice("lines", ["Lines", "No lines"], show),
  );
  move();
  show();
} else {
  $("scene").hidden = true;
  $("no-scene").hidden = false;
  renderLegend(data.legends[shown.coloring]);
}

function renderLegend(legend) {
  const parts = [element("p", { textContent: legend.title })];
  if (legend.ramp.length) {
    const canvas = element("canvas", { width: legend.ramp.length, height: 1 });
    const context = canvas.getContext("2d");
    legend.ramp.forEach((color, column) => {
      context.fillStyle = color;
      context.fillRect(column, 0, 1, 1);
    });
    const ticks = element("div", {}, ...rampMarks(legend, unit, { wanted: 5, room: 0.15 }).map(([at, text]) => {
      const tick = element("span", { textContent: text });
      tick.style.left = `${100 * at}%`;
      return tick;
    }));
    parts.push(element("div", { className: "ramp" }, canvas, ticks));
  }
  parts.push(element("ul", { className: "swatches" }, ...legend.swatches.map(({ color, label: text }) => {
    const dot = element("i");
    dot.style.background = color;
    return element("li", {}, dot, text);
  })));
  $("legend").replaceChildren(...parts);
}

// ---------------------------------------------------------------- figures

$("title").textContent = results.source ? `${results.source.name} → ${results.target.name}` : results.pair;
document.title = `${$("title").textContent} · cgf-viewer report`;
$("about").textContent = [results.model.reason, `${results.program}, ${results.written.slice(0, 10)}`].join(" · ");
$("messages").append(...results.messages.map(({ text }) => element("p", { textContent: text })));
if (scene.left_out) {
  $("messages").append(element("p", { textContent: `The scene leaves out ${count(scene.left_out)} points, evenly; all figures count all of them.` }));
}

if (results.diagnosis) {
  const { verdict, findings } = results.diagnosis;
  const evidence = ({ name, value, quantity: kind, threshold, rule }) =>
    `${name}: ${quantity(value, kind, unit)}${threshold === null ? "" : ` (${rule} ${quantity(threshold, kind, unit)})`}`;
  $("diagnosis").hidden = false;
  $("diagnosis").append(element("p", { className: "verdict", textContent: verdict }),
    element("ul", {}, ...findings.filter(({ severity }) => severity !== "fine").map((finding) => element("li", {},
      element("b", { textContent: `${named(finding.severity)}: ` }), finding.sentence,
      element("small", { textContent: finding.evidence.map(evidence).join(" · ") })))));
}
$("precision").textContent = numbers ? percent(numbers.precision) : "–";
$("precision-label").textContent = numbers ? `within ${length(numbers.precision_radius, unit)}` : "no pose to judge by";
pairs($("figures"), [
  ...(numbers ? [
    ["Matches", count(numbers.matches)], ["Inlier ratio", percent(numbers.inlier_ratio)],
    ["Median error", length(numbers.median_error, unit)],
  ] : []),
  ["Points", `${count(results.source.points)} → ${count(results.target.points)}`],
  ["After downsampling", `${count(results.source.prepared)} → ${count(results.target.prepared)}`],
  ["Errors against", results.reference === null ? "nothing" : named(results.reference).toLowerCase()],
  ...(estimate ? [["Estimate", estimate.found ? named(estimate.method) : "none found"]] : []),
  ...(estimate?.rotation_error_deg != null ? [
    ["Rotation error", `${estimate.rotation_error_deg.toFixed(2)}°`], ["Translation error", length(estimate.translation_error, unit)],
  ] : []),
  ...(estimate?.fitness != null ? [["Points that fit", percent(estimate.fitness)]] : []),
]);

const largest = Math.max(1, ...results.funnel.map((step) => step.count));
$("funnel").append(...results.funnel.map((step) => {
  const bar = element("i");
  bar.style.width = `${(100 * step.count) / largest}%`;
  return element("li", {}, bar, element("span", { textContent: step.name }), element("b", { textContent: count(step.count) }));
}));

function renderCurve() {
  if (!curve) return;
  const last = curve.thresholds.at(-1);
  const plot = axes($("curve"), { x: lengthAxis(last, unit, "error accepted"), y: shareAxis("right matches") });
  if (!plot) return;
  const line = linePath(plot, curve.thresholds, curve.precision);
  const at = Math.min(numbers.precision_radius, last);
  const share = interpolate(curve.thresholds, curve.precision, at);
  const text = label(plot.x(at) + 7, plot.y(share) + (share < 0.2 ? -9 : 18), `${percent(share)} within ${length(at, unit)}`, "start", "value");
  $("curve").replaceChildren(...plot.parts,
    vector("path", { class: "fill", d: `${line}L${plot.x(last)} ${plot.box.bottom}L${plot.box.left} ${plot.box.bottom}Z` }),
    vector("path", { class: "line", d: line }),
    vector("line", { class: "mark", x1: plot.x(at), x2: plot.x(at), y1: plot.box.top, y2: plot.box.bottom }),
    vector("circle", { cx: plot.x(at), cy: plot.y(share), r: 3.5 }), text);
  keepInside(text, plot);
}
new ResizeObserver(renderCurve).observe($("curve"));

const { resolved, settings } = results;
const lengths = ["support_radius", "min_radius", "lrf_radius", "normal_radius", "voxel_size", "tau", "precision_radius", "inlier_distance"];
pairs($("settings"), [
  ["Descriptor", `${resolved.descriptor.toUpperCase()}, ${resolved.dim} dimensions`],
  ...lengths.filter((name) => typeof resolved[name] === "number").map((name) => [named(name), length(resolved[name], unit, 3)]),
  ["Filters", [settings.mutual && "mutual", settings.max_ratio !== null && `ratio ≤ ${settings.max_ratio}`, settings.surest !== null && `surest ${percent(settings.surest, 0)}`].filter(Boolean).join(", ") || "none"],
  ["Diameter", `${significant(unit.diameter, 4)} ${unit.name}`],
]);

for (const [name, rows] of Object.entries(results.target_from_source)) {
  if (!rows) continue;
  const text = rows.map((row) => row.map((value) => value.toFixed(6).padStart(11)).join(" ")).join("\n");
  $("poses").append(element("p", { textContent: named(name) }), element("pre", { textContent: text, tabIndex: 0 }));
}
$("again").append(...[["In the browser", results.view_command], ["The matches as a file", results.command]]
  .filter(([, command]) => command)
  .flatMap(([title, command]) => [element("p", { textContent: title }), element("pre", { textContent: command, tabIndex: 0 })]));
