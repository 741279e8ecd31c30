// Poses: those known with how good each is, the way between two of them, and the search for another.

import { element, options, setUnlessBusy, watchBusy } from "../lib/dom.js";
import { count, field, length, percent, significant } from "../lib/format.js";
import { listen } from "../server.js";

const COLUMNS = ["Pose", "Inliers", "Fitness", "RMSE", "Rotation", "Shift", "Time", "Estimate"];
const HINTS = {
  Inliers: "Correspondences that pass the filters and agree with the pose",
  Fitness: "Share of the source's points that come near a point of the target",
  RMSE: "Root mean square distance of those points",
  Rotation: "Angle to the ground truth", Shift: "Distance of the translations to the ground truth",
  Estimate: "Which pose errors are measured against where that is the estimate",
};
const METHODS = [["ransac", "RANSAC"], ["fgr", "FGR"], ["icp", "ICP"]];

const body = element("tbody");
const from = element("select", { id: "pose-from" });
const to = element("select", { id: "pose-to" });
const slider = element("input", { type: "range", id: "pose-share", min: "0", max: "1", step: "0.005", value: "1" });
const flip = element("button", { type: "button", textContent: "Flip", title: "Before and after: switch between the two poses (B)" });
const residual = element("input", { type: "checkbox", role: "switch", id: "pose-residual" });
const inlier = element("input", { type: "text", inputMode: "decimal", id: "run-inlier", placeholder: "usual" });
const iterations = element("input", { type: "text", inputMode: "numeric", id: "run-iterations", placeholder: "usual" });
const refine = element("input", { type: "checkbox", role: "switch", id: "run-refine", checked: true });
const metric = element("select", { id: "run-metric" });
const start = element("select", { id: "run-start" });
const go = element("button", { type: "button", id: "run-go", className: "primary" });
const stop = element("button", { type: "button", textContent: "Stop", hidden: true });
const news = element("p", { className: "task", role: "status" });

let page;
let rows = [];
let method = "ransac";
let fetched = -1;
let isFetching = false;
const unitOf = element("span", { className: "unit" });

export function mount(root, given) {
  page = given;
  root.append(resultsPanel(), wayPanel(), searchPanel());
  for (const control of [slider, from, to]) watchBusy(control);
  slider.addEventListener("input", () => slide(Number(slider.value)));
  for (const select of [from, to]) select.addEventListener("change", () => slide(Number(slider.value)));
  flip.onclick = beforeAfter;
  residual.addEventListener("change", () => page.change({ coloring: residual.checked ? "residual" : "error" }));
  go.onclick = run;
  stop.onclick = () => page.api("tasks/register", { method: "DELETE" });
  page.command("before-after", { label: "Before and after: switch between two poses", keys: "b", run: beforeAfter });
  page.command("residual", {
    label: "Colour by distance of the surfaces, or by error",
    run: () => page.change({ coloring: page.chosen().coloring === "residual" ? "error" : "residual" }),
  });
  for (const [name, label] of METHODS) {
    page.command(`run-${name}`, { label: `Estimate the pose by ${label}`, run: () => { choose(name); run(); } });
  }
  listen(() => renderTask());
  choose(method);
}

function resultsPanel() {
  const head = element("tr", {}, ...COLUMNS.map((name) => element("th", { scope: "col", textContent: name, title: HINTS[name] ?? "" })));
  const table = element("table", { className: "pose-table" }, element("thead", {}, head), body);
  const scroll = element("div", { className: "scroll", tabIndex: 0 }, table);
  scroll.setAttribute("role", "region");
  scroll.ariaLabel = "Poses and how good they are";
  return element("div", { className: "panel" }, element("h2", { textContent: "Poses" }), scroll);
}

function wayPanel() {
  const label = (text, control, title = "") => element("label", { className: "label", htmlFor: control.id, textContent: text, title });
  slider.ariaLabel = "Place on the way between the two poses";
  return element("div", { className: "panel" }, element("h2", { textContent: "Between two poses" }),
    element("div", { className: "row" }, label("From", from), from),
    element("div", { className: "row" }, label("To", to), to),
    element("div", { className: "row" }, slider, flip),
    element("div", { className: "row" }, label("Colour by residual", residual, "Distance to the nearest point of the other cloud"), toggle(residual)));
}

function searchPanel() {
  const label = (text, control, title = "") => element("label", { className: "label", htmlFor: control.id, textContent: text, title });
  const choice = element("div", { className: "choice", role: "radiogroup" }, ...METHODS.map(([name, text]) => {
    const input = element("input", { type: "radio", name: "run-method", value: name });
    input.onchange = () => choose(name);
    return element("label", {}, input, element("span", { textContent: text }));
  }));
  choice.ariaLabel = "Method";
  options(metric, [["plane", "Planes"], ["point", "Points"]]);
  const number = (input, unit) => element("span", { className: "number" }, input, unit);
  const steps = element("span", { className: "unit" });
  return element("div", { className: "panel search" }, element("h2", { textContent: "Estimate anew" }, element("small")),
    element("div", { className: "row" }, choice),
    element("div", { className: "row pairwise" }, label("Within", inlier, "How near partners must come to agree: the inlier distance"), number(inlier, unitOf),
      label("At most", iterations, "Samples of RANSAC, or steps of the others"), number(iterations, steps)),
    element("div", { className: "row only-features" }, label("ICP afterwards", refine), toggle(refine)),
    element("div", { className: "row only-icp pairwise" }, label("Start", start), start, label("to", metric, "What ICP brings the points near to"), metric),
    element("div", { className: "row" }, go, stop, news));
}

const toggle = (input) => element("span", { className: "switch" }, input, element("span", { ariaHidden: "true" }));

function choose(name) {
  method = name;
  go.textContent = `Run ${METHODS.find(([key]) => key === name)[1]}`;
  for (const input of document.querySelectorAll("input[name=run-method]")) input.checked = input.value === name;
  const panel = go.closest(".panel");
  for (const row of panel?.querySelectorAll(".only-features") ?? []) row.hidden = name === "icp";
  for (const row of panel?.querySelectorAll(".only-icp") ?? []) row.hidden = name !== "icp";
}

async function run() {
  const { unit } = page.state() ?? {};
  if (!unit) return;
  const distance = numberIn(inlier, "Inlier distance");
  const most = numberIn(iterations, "At most");
  if (distance === undefined || most === undefined) return;
  const wanted = { method, metric: metric.value, refine: refine.checked };
  if (distance !== null) wanted.inlier_distance = distance * field(unit).size;
  if (most !== null) wanted.iterations = Math.round(most);
  if (method === "icp" && start.value) wanted.start = start.value;
  await tell(() => page.api("poses/runs", { method: "POST", body: wanted }));
  page.open("poses");
}

/** The number in a field, null where it is empty, undefined where it is none, which is said. */
function numberIn(input, name) {
  const text = input.value.trim().replace(",", ".");
  if (text === "") return null;
  if (Number(text) > 0) return Number(text);
  page.refuse(`${name} must be a number above 0, got “${text}”`);
  return undefined;
}

async function tell(request) {
  try {
    await request();
  } catch (error) {
    page.refuse(error.message);
  }
}

/** How settings name the pose of a row. */
const nameOf = (row) => (row.is_estimate ? "estimate" : row.name);

function show(row) {
  const name = nameOf(row);
  const offered = page.state().controls.poses.includes(name);
  page.change(offered ? { pose: name } : { pose_from: null, pose_to: name });
}

function slide(share) {
  const { settings } = page.state();
  const overlaid = settings.layout === "overlaid" ? {} : { layout: "overlaid" };
  page.change({ ...overlaid, pose_from: from.value, pose_to: to.value, pose_share: share });
}

function beforeAfter() {
  const settings = page.chosen();
  if (settings.pose_from === null || settings.pose_to === null) {
    page.change({ pose_from: from.value, pose_to: to.value, pose_share: page.state().pose === from.value ? 1 : 0 });
  } else {
    page.change({ pose_share: settings.pose_share > 0.5 ? 0 : 1 });
  }
}

export function render(state) {
  const { settings, unit } = { ...state, settings: page.chosen() };
  unitOf.textContent = field(unit).name;
  residual.checked = settings.coloring === "residual";
  renderWay(state, settings);
  renderTask();
  if (state.revision !== fetched && slider.dataset.busy !== "true") fetchRows(state.revision);
}

function renderWay(state, settings) {
  const known = rows.filter((row) => row.found).map((row) => [nameOf(row), row.label]);
  const entries = known.length ? known : state.controls.poses.map((name) => [name, name]);
  options(from, entries);
  options(to, entries);
  options(start, [["", "As shown"], ...entries]);
  const best = ["ground_truth", "estimate"].find((name) => state.controls.poses.includes(name)) ?? "loaded";
  const end = settings.pose_to ?? (state.pose && state.pose !== "loaded" ? state.pose : best);
  setUnlessBusy(from, settings.pose_from ?? (entries.some(([name]) => name === from.value) ? from.value : "loaded"));
  setUnlessBusy(to, end);
  setUnlessBusy(slider, settings.pose_from === null ? 1 : settings.pose_share);
  slider.setAttribute("aria-valuetext", `${Math.round(100 * Number(slider.value))} percent of the way`);
}

async function fetchRows(revision) {
  if (isFetching) return;
  isFetching = true;
  try {
    rows = await page.api("poses");
    fetched = revision;
  } catch {
    fetched = revision;
    rows = [];
  } finally {
    isFetching = false;
  }
  const state = page.state();
  renderRows(state);
  renderWay(state, page.chosen());
  if (state.revision !== fetched && slider.dataset.busy !== "true") fetchRows(state.revision);
}

function renderRows({ unit, pose }) {
  const focused = document.activeElement?.closest?.(".pose-table tr")?.dataset.name;
  const part = document.activeElement?.matches?.(".pose-table input") ? "input" : "button";
  body.replaceChildren(...rows.map((row) => {
    const name = element("button", { type: "button", className: "link", textContent: row.label, title: "Show the source in this pose", disabled: !row.found });
    name.onclick = () => show(row);
    const shown = row.found && (pose === row.name || pose === nameOf(row));
    name.setAttribute("aria-pressed", String(shown));
    const cells = [
      row.inliers === null ? "–" : `${count(row.inliers)}`,
      percent(row.fitness), length(row.rmse, unit),
      row.rotation_error_deg === null ? "–" : `${row.rotation_error_deg.toFixed(row.rotation_error_deg < 10 ? 2 : 1)}°`,
      length(row.translation_error, unit),
      row.elapsed_s === null ? "" : `${row.elapsed_s.toFixed(2)} s`,
    ];
    const line = element("tr", {}, element("th", { scope: "row" }, name),
      ...(row.found ? cells : ["nothing found", "", "", "", "", cells[5]]).map((text) => element("td", { textContent: text })), estimateCell(row));
    if (row.inliers !== null) line.children[1].title = `of ${count(row.correspondences)}`;
    line.dataset.name = row.name;
    line.classList.toggle("shown", shown);
    return line;
  }));
  if (focused) body.querySelector(`tr[data-name="${focused}"] ${part}`)?.focus();
}

function estimateCell(row) {
  if (!row.found || !(row.name === "automatic" || row.name.startsWith("run-"))) return element("td");
  const input = element("input", { type: "radio", name: "pose-estimate", checked: row.is_estimate, ariaLabel: `Take ${row.label} as the estimate` });
  input.onchange = () => tell(() => page.api("poses/estimate", { method: "POST", body: { name: row.name } }));
  return element("td", {}, input);
}

function renderTask() {
  const task = page.state()?.status.tasks.find(({ kind }) => kind === "register");
  stop.hidden = !task;
  go.disabled = Boolean(task);
  news.textContent = task ? `${task.text} ${significant(100 * task.progress, 2)} %` : "";
}
