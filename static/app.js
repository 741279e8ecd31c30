// The page: shows the state that the server sends, and sends back what a person chooses. It keeps no state of its own
// but the curve before the last change, so every tab shows the same.

const $ = (id) => document.getElementById(id);
const LENGTHS = ["support_radius", "lrf_radius", "voxel_size", "error_scale"];
const DEFAULTS = {
  descriptor: "cgf", dim: null, support_radius: null, lrf_radius: null, voxel_size: null, mutual: false, max_ratio: null, line_count: 300,
  line_choice: "stratified", error_scale: null, point_size: 1, layout: "side_by_side", pose: null, reference: null,
  coloring: "error",
};

let state = null;
let refusal = null; // why the last change was not made
const dismissed = new Set();
let curve = null;
let curveBefore = null;

// ---------------------------------------------------------------- talking to the server

// One request at a time: while one is under way, later changes gather and go together.
let waiting = null;
let underWay = null;

function change(settings) {
  waiting = { ...waiting, ...settings };
  if (!underWay) send();
}

/** What was chosen, though the server may not know it yet: a control never jumps back meanwhile. */
const chosen = () => ({ ...state.settings, ...underWay, ...waiting });

const pending = (name) => ({ ...underWay, ...waiting })[name];

async function send() {
  while (waiting) {
    underWay = waiting;
    waiting = null;
    const body = JSON.stringify(underWay);
    try {
      const answer = await fetch("api/settings", {
        method: "PATCH", headers: { "Content-Type": "application/json" }, body,
      });
      const content = await answer.json();
      underWay = null;
      refusal = answer.ok ? null : content.message;
      if (answer.ok) show(content);
      else render();
    } catch {
      underWay = null;
      offline();
    }
  }
}

function connect() {
  const events = new EventSource("api/events");
  events.addEventListener("state", (event) => show(JSON.parse(event.data)));
  events.addEventListener("status", (event) => {
    if (!state) return;
    state.status = JSON.parse(event.data);
    renderStatus();
  });
  events.onerror = () => offline();
}

function offline() {
  $("status").dataset.phase = "failed";
  $("status-text").textContent = "Not connected: has cgf-viewer stopped?";
  $("cancel").hidden = true;
}

function show(next) {
  // Answers and events may overtake each other.
  if (state && next.revision < state.revision) return;
  const samePair = state && state.settings.pair === next.settings.pair;
  const key = JSON.stringify(next.curve);
  if (next.curve && (!curve || curve.key !== key)) {
    curveBefore = samePair && curve && curve.scale === next.legend?.scale ? curve.value : null;
    curve = { key, value: next.curve, scale: next.legend?.scale };
  } else if (!next.curve && !samePair) {
    curve = curveBefore = null;
  }
  state = next;
  render();
}

// ---------------------------------------------------------------- numbers and units

const count = (value) => value.toLocaleString("en-US");
const percent = (share, digits = 1) => (share === null ? "–" : `${(100 * share).toFixed(digits)} %`);
const isRelative = () => state.unit.name !== "m";
const significant = (value, digits) => String(Number(value.toPrecision(digits)));

/** A length for people: centimetres and metres in rooms, shares of the diameter for objects. */
function length(value, digits = 2) {
  if (value === null) return "–";
  if (isRelative()) return `${significant((100 * value) / state.unit.diameter, digits)} % diam.`;
  return value < 0.9995 ? `${significant(100 * value, digits)} cm` : `${significant(value, digits + 1)} m`;
}

/** Unit of the fields, and what one of it is in the units of the clouds. */
const field = () => (isRelative() ? { name: "% ⌀", size: state.unit.diameter / 100 } : { name: "m", size: 1 });

// Lengths and sizes are felt as ratios, so their sliders are logarithmic.
const toSlider = (value, { low, high }) => Math.round((1000 * Math.log(value / low)) / Math.log(high / low));
const fromSlider = (position, { low, high }) => Number((low * (high / low) ** (position / 1000)).toPrecision(3));

const lengthOf = (name) => chosen()[name] ?? state.controls[name].default;

// ---------------------------------------------------------------- drawing the page

function render() {
  if (!state) return;
  renderStatus();
  renderNotices();
  renderPair();
  if (!state.controls) return;
  renderControls();
  renderLegend();
  renderFigures();
  renderCurve();
  renderFunnel();
}

function renderStatus() {
  const { phase, text, progress, elapsed_s } = state.status;
  $("status").dataset.phase = phase;
  const working = phase === "working";
  // Only the text is read aloud.
  $("status-text").textContent = text;
  $("status-share").textContent = working && progress > 0 ? `${Math.round(100 * progress)} %`
    : phase === "ready" && elapsed_s !== null ? `${elapsed_s.toFixed(2)} s` : "";
  $("cancel").hidden = !working;
  $("progress").style.width = `${100 * (working ? progress : 1)}%`;
  $("progress").classList.toggle("done", !working);
}

function renderNotices() {
  // An error may happen again, so closing it is for this time only.
  const messages = state.messages.map(({ level, text }) => {
    const key = level === "error" ? `${state.revision} ${text}` : text;
    return { level, text, key, close: () => dismissed.add(key) };
  });
  if (refusal) {
    const text = `${refusal.replace(/\.?$/, ".")} Nothing was changed.`;
    messages.unshift({ level: "error", text, key: null, close: () => { refusal = null; } });
  }
  $("notices").replaceChildren(...messages.filter(({ key }) => !dismissed.has(key)).map(({ level, text, close }) => {
    const button = element("button", { type: "button", textContent: "✕", ariaLabel: "Close this message" });
    button.onclick = () => {
      close();
      renderNotices();
    };
    const notice = element("div", { className: "notice" }, element("p", { textContent: text }), button);
    notice.dataset.level = level;
    return notice;
  }));
}

function renderPair() {
  const several = state.pairs.length > 1;
  $("pair").hidden = !several;
  $("pair-names").hidden = several;
  if (several) {
    options($("pair"), state.pairs.map((name, index) => [String(index), name]));
    $("pair").value = String(state.settings.pair);
  }
  if (!state.source) {
    $("pair-names").textContent = state.pairs[state.settings.pair];
    return;
  }
  const arrow = element("span", { className: "arrow", textContent: "→" });
  $("pair-names").replaceChildren(state.source.name, arrow, state.target.name);
  document.title = `${state.source.name} → ${state.target.name} · cgf-viewer`;
  $("model").textContent = state.model.reason;
  $("model").title = state.model.reason;
  const apart = state.settings.layout === "side_by_side";
  for (const side of ["source", "target"]) {
    $(`tag-${side}`).hidden = !apart;
    $(`tag-${side}`).textContent = `${side === "source" ? "Source" : "Target"} · ${count(state[side].prepared)} points`;
  }
}

function renderControls() {
  const { controls } = state;
  const settings = chosen();
  // Where nothing was chosen, the server says what it took.
  const current = {
    coloring: settings.coloring, layout: settings.layout,
    pose: pending("pose") ?? state.pose, reference: pending("reference") ?? state.reference,
  };
  for (const group of document.querySelectorAll("[data-setting]")) {
    const name = group.dataset.setting;
    const offered = { pose: controls.poses, reference: controls.references }[name];
    for (const input of group.querySelectorAll("input")) {
      input.checked = input.value === current[name];
      input.disabled = offered !== undefined && !offered.includes(input.value);
    }
  }
  options($("descriptor"), controls.descriptors.map((name) => [name, name.toUpperCase()]));
  setUnlessBusy($("descriptor"), settings.descriptor);
  renderDims({ dims: controls.dims, dim: pending("dim") ?? controls.dim });
  for (const name of LENGTHS) {
    const { size, name: unit } = field();
    const slider = $(name);
    const value = lengthOf(name);
    setUnlessBusy(slider, toSlider(Math.max(value, 1e-12), controls[name]));
    setUnlessBusy($(`${name}-number`), significant(value / size, 3));
    $(`${name}-number`).nextElementSibling.textContent = unit;
  }
  setUnlessBusy($("point_size"), toSlider(settings.point_size, controls.point_size));
  $("point_size-value").textContent = `${settings.point_size.toFixed(2)}×`;
  $("mutual").checked = settings.mutual;
  setUnlessBusy($("max_ratio"), settings.max_ratio ?? 1);
  $("max_ratio-value").textContent = settings.max_ratio === null ? "off" : settings.max_ratio.toFixed(2);
  setUnlessBusy($("line_count"), linesToSlider(settings.line_count));
  $("line_count-value").textContent = count(settings.line_count);
  setUnlessBusy($("line_choice"), settings.line_choice);
  $("copy").disabled = state.command === "";
}

function renderDims({ dims, dim }) {
  if ($("dims").dataset.dims !== String(dims)) {
    $("dims").dataset.dims = String(dims);
    $("dims").replaceChildren(...dims.map((value) => {
      const input = element("input", { type: "radio", name: "dim", value: String(value) });
      input.onchange = () => change({ dim: value });
      return element("label", {}, input, element("span", { textContent: String(value) }));
    }));
  }
  for (const input of $("dims").querySelectorAll("input")) input.checked = input.value === String(dim);
}

function renderLegend() {
  const { legend } = state;
  const against = legend.coloring === "error" && state.reference === "estimate" ? ", relative to the estimate" : "";
  $("legend-title").textContent = legend.title + against;
  $("legend-title").title = legend.title + against;
  $("ramp").hidden = legend.ramp.length === 0;
  if (legend.ramp.length) {
    const canvas = $("ramp-colors");
    canvas.width = legend.ramp.length;
    const context = canvas.getContext("2d");
    legend.ramp.forEach((color, column) => {
      context.fillStyle = color;
      context.fillRect(column, 0, 1, 1);
    });
    const { values, size } = ticks(legend.scale);
    const marks = values.filter((value) => value * size < legend.scale).map((value) => [value * size, significant(value, 3)]);
    marks.push([legend.scale, `≥ ${length(legend.scale)}`]);
    $("ramp-ticks").replaceChildren(...marks.map(([value, text]) => {
      const tick = element("span", { textContent: text });
      tick.style.left = `${(100 * value) / legend.scale}%`;
      return tick;
    }));
    thinTicks();
  }
  $("swatches").replaceChildren(...legend.swatches.map(({ color, label }) => {
    const dot = element("i");
    dot.style.background = color;
    return element("li", { title: label }, dot, label);
  }));
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

function renderFigures() {
  const { numbers, estimate, source, target } = state;
  $("precision").textContent = numbers ? percent(numbers.precision) : "–";
  $("precision-label").textContent = numbers
    ? `within ${length(numbers.precision_radius)}`
    : state.status.phase === "working" ? "waiting for matches" : "no pose to judge by";
  const features = (cloud) => (cloud.features === null ? "–" : count(cloud.features));
  const rows = [
    ["Matches", numbers ? count(numbers.matches) : "–"],
    ["Inlier ratio", numbers ? percent(numbers.inlier_ratio) : "–"],
    ["Median error", numbers ? length(numbers.median_error) : "–"],
    ["Points", `${count(source.points)} → ${count(target.points)}`],
    ["Features", `${features(source)} → ${features(target)}`],
    [estimate?.rotation_error_deg === null || !estimate ? "Estimate" : "Estimate error", describeEstimate(estimate)],
  ];
  $("figures").replaceChildren(...rows.flatMap(([name, value]) => [
    element("dt", { textContent: name }), element("dd", { textContent: value, title: value }),
  ]));
}

function describeEstimate(estimate) {
  if (!estimate) return "–";
  if (!estimate.found) return "none found";
  if (estimate.rotation_error_deg !== null) {
    return `${estimate.rotation_error_deg.toFixed(1)}°, ${length(estimate.translation_error)}`;
  }
  return estimate.given ? "as given" : `${percent(estimate.fitness, 0)} of points fit`;
}

function renderFunnel() {
  const largest = Math.max(1, ...state.funnel.map((step) => step.count));
  $("funnel").replaceChildren(...state.funnel.map((step) => {
    const bar = element("i");
    bar.style.width = `${(100 * step.count) / largest}%`;
    return element("li", {}, bar, element("span", { textContent: step.name }), element("b", { textContent: count(step.count) }));
  }));
}

function renderCurve(pointer = null) {
  const svg = $("curve");
  const { width, height } = svg.getBoundingClientRect();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const shown = state.curve;
  $("curve-note").textContent = shown ? `of ${count(shown.count)} with a true partner` : "";
  if (!shown || width === 0) {
    svg.replaceChildren();
    return;
  }
  const box = { left: 34, right: width - 10, top: 8, bottom: height - 32 };
  const last = shown.thresholds.at(-1);
  const x = (threshold) => box.left + ((box.right - box.left) * threshold) / last;
  const y = (share) => box.bottom - (box.bottom - box.top) * share;
  const path = ({ thresholds, precision }) => thresholds.map((threshold, index) =>
    `${index ? "L" : "M"}${x(threshold).toFixed(1)} ${y(precision[index]).toFixed(1)}`).join("");
  const parts = [];
  for (const share of [0, 0.25, 0.5, 0.75, 1]) {
    parts.push(vector("line", { class: "grid", x1: box.left, x2: box.right, y1: y(share), y2: y(share) }));
    if (share % 0.5 === 0) parts.push(label(box.left - 5, y(share) + 4, `${100 * share}`, "end"));
  }
  const { values, unit, size } = ticks(last);
  for (const value of values) parts.push(label(x(value * size), box.bottom + 14, significant(value, 3), "middle"));
  parts.push(label((box.left + box.right) / 2, height - 3, `error accepted (${unit})`, "middle"));
  const side = label(0, 0, "right matches (%)", "middle");
  side.setAttribute("transform", `translate(9 ${(box.top + box.bottom) / 2}) rotate(-90)`);
  parts.push(side);
  if (curveBefore) parts.push(vector("path", { class: "before", d: path(curveBefore) }));
  parts.push(vector("path", { class: "fill", d: `${path(shown)}L${x(last)} ${box.bottom}L${box.left} ${box.bottom}Z` }));
  parts.push(vector("path", { class: "line", d: path(shown) }));
  const radius = state.numbers?.precision_radius;
  const read = pointer === null ? Math.min(radius ?? last, last)
    : (Math.min(Math.max(pointer - box.left, 0), box.right - box.left) / (box.right - box.left)) * last;
  const share = interpolate(shown, read);
  parts.push(vector("line", { class: "mark", x1: x(read), x2: x(read), y1: box.top, y2: box.bottom }));
  parts.push(vector("circle", { cx: x(read), cy: y(share), r: 3.5 }));
  const text = label(x(read) + 7, y(share) + (share < 0.2 ? -9 : 18), `${percent(share)} within ${length(read)}`, "start");
  text.setAttribute("class", "value");
  parts.push(text);
  svg.replaceChildren(...parts);
  const over = text.getBBox().x + text.getBBox().width - box.right;
  if (over > 0) text.setAttribute("x", x(read) + 7 - over);
}

/** Round values along the error axis, in the unit that suits its length. */
function ticks(last) {
  const [unit, size] = isRelative() ? ["% of diameter", state.unit.diameter / 100] : last < 1 ? ["cm", 0.01] : ["m", 1];
  const span = last / size;
  const magnitude = 10 ** Math.floor(Math.log10(span));
  const step = [0.1, 0.2, 0.5, 1, 2].map((share) => share * magnitude).find((candidate) => span / candidate <= 6);
  const values = [];
  for (let value = 0; value <= span * 1.0001; value += step) values.push(Number(value.toPrecision(6)));
  return { values, unit, size };
}

function interpolate({ thresholds, precision }, at) {
  const position = (at / thresholds.at(-1)) * (thresholds.length - 1);
  const index = Math.min(Math.floor(position), thresholds.length - 2);
  return precision[index] + (precision[index + 1] - precision[index]) * (position - index);
}

// ---------------------------------------------------------------- building elements

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function vector(tag, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function label(x, y, text, anchor) {
  const made = vector("text", { x, y, "text-anchor": anchor });
  made.textContent = text;
  return made;
}

function options(select, entries) {
  const key = JSON.stringify(entries);
  if (select.dataset.entries === key) return;
  select.dataset.entries = key;
  select.replaceChildren(...entries.map(([value, text]) => element("option", { value, textContent: text })));
}

/** Do not move a control under the hand of the person who uses it. */
function setUnlessBusy(control, value) {
  if (control.dataset.busy !== "true") control.value = value;
}

// Few lines and many lines both need room on the slider.
const linesToSlider = (lines) => Math.round(1000 * Math.sqrt(lines / state.controls.line_count.high));
const linesFromSlider = (position) => {
  const lines = state.controls.line_count.high * (position / 1000) ** 2;
  return lines < 100 ? Math.round(lines) : Math.round(lines / 10) * 10;
};

// ---------------------------------------------------------------- listening to the person

function listen() {
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  for (const control of document.querySelectorAll("input[type=range], input[type=text]")) {
    control.addEventListener("input", () => { control.dataset.busy = "true"; });
    for (const end of ["change", "blur"]) control.addEventListener(end, () => { control.dataset.busy = "false"; });
  }
  for (const group of document.querySelectorAll("[data-setting]")) {
    group.addEventListener("change", (event) => change({ [group.dataset.setting]: event.target.value }));
  }
  for (const name of ["support_radius", "lrf_radius", "voxel_size"]) {
    // These take a computation, so they act when the slider is let go.
    $(name).addEventListener("input", () => {
      if (state?.controls) $(`${name}-number`).value = significant(fromSlider($(name).value, state.controls[name]) / field().size, 3);
    });
    $(name).addEventListener("change", () => state?.controls && change({ [name]: fromSlider($(name).value, state.controls[name]) }));
  }
  for (const name of ["error_scale", "point_size"]) {
    $(name).addEventListener("input", () => state?.controls && change({ [name]: fromSlider($(name).value, state.controls[name]) }));
  }
  for (const name of LENGTHS) {
    $(`${name}-number`).addEventListener("change", (event) => typed(name, event.target));
  }
  $("pair").addEventListener("change", (event) => change({ pair: Number(event.target.value) }));
  $("descriptor").addEventListener("change", (event) => change({ descriptor: event.target.value }));
  $("line_choice").addEventListener("change", (event) => change({ line_choice: event.target.value }));
  $("mutual").addEventListener("change", (event) => change({ mutual: event.target.checked }));
  $("max_ratio").addEventListener("input", (event) => {
    const ratio = Number(event.target.value);
    change({ max_ratio: ratio >= 1 ? null : ratio });
  });
  $("line_count").addEventListener("input", (event) => state?.controls && change({ line_count: linesFromSlider(event.target.value) }));
  $("home").addEventListener("click", () => fetch("api/camera/reset", { method: "POST" }));
  $("cancel").addEventListener("click", () => fetch("api/cancel", { method: "POST" }));
  $("defaults").addEventListener("click", () => change({ ...DEFAULTS }));
  $("copy").addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(state.command);
      $("copy").textContent = "Copied";
      setTimeout(() => { $("copy").textContent = "Copy command"; }, 1500);
    } catch {
      // Browsers allow the clipboard on this machine or over https only.
      window.prompt("The command:", state.command);
    }
  });
  $("curve").addEventListener("pointermove", (event) => state?.curve && renderCurve(event.offsetX));
  $("curve").addEventListener("pointerleave", () => state?.curve && renderCurve());
  new ResizeObserver(() => {
    if (!state?.controls) return;
    renderCurve();
    renderLegend();
  }).observe($("curve"));
}

function typed(name, input) {
  if (!state?.controls) return;
  const text = input.value.trim().replace(",", ".");
  const value = Number(text);
  if (text === "") change({ [name]: null });
  else if (Number.isFinite(value)) change({ [name]: value * field().size });
  else {
    refusal = `${input.closest(".row").querySelector(".label").textContent} must be a number, got “${text}”.`;
    render();
  }
}

listen();
connect();
