// Two or three descriptors or settings beside each other: same pair, same camera, same scale.

import { element, options } from "../lib/dom.js";
import { field, percent, significant } from "../lib/format.js";
import { listen } from "../server.js";

const MOST = 3;

let page;
let draft = []; // columns as the fields show them: descriptor, dim, radius (as typed)
let isDirty = false;
const list = element("ol", { className: "columns" });
const add = element("button", { type: "button", textContent: "Add a column" });
const go = element("button", { type: "button", className: "primary", id: "compare-go", textContent: "Compare" });
const leave = element("button", { type: "button", id: "compare-leave", textContent: "Leave" });
const both = element("input", { type: "checkbox", role: "switch", id: "compare-pair" });
const news = element("p", { className: "task", role: "status" });

export function mount(root, given) {
  page = given;
  const presets = [
    ["Dimensions", "The features in all, half and a quarter of their dimensions", dimensions],
    ["Descriptors", "All descriptors that there are", descriptors],
    ["Radii", "The feature with a small, the usual and a large radius", radii],
  ].map(([text, title, make]) => {
    const button = element("button", { type: "button", textContent: text, title });
    button.onclick = () => apply(make(page.state()));
    return button;
  });
  root.append(
    element("div", { className: "panel" }, element("h2", { textContent: "Columns, from left to right" }), list,
      element("div", { className: "row" }, add, go, leave, news)),
    element("div", { className: "panel" }, element("h2", { textContent: "Ready made" }),
      element("div", { className: "row" }, ...presets),
      element("div", { className: "row" }, element("label", { className: "label", htmlFor: both.id, textContent: "With the target" }),
        element("span", { className: "switch" }, both, element("span", { ariaHidden: "true" }))),
      element("p", { className: "hint", textContent: "Each column is the source, coloured by the error of its own matches, as in the paper’s error figure." })),
  );
  add.onclick = () => {
    draft = [...draft, { ...draft.at(-1) }];
    isDirty = true;
    renderDraft();
  };
  go.onclick = () => apply(draft);
  leave.onclick = () => page.change({ columns: [] });
  both.addEventListener("change", () => page.change({ compare_pair: both.checked }));
  page.command("compare", { label: "Compare descriptors", run: () => { page.open("compare"); apply(descriptors(page.state())); } });
  page.command("leave-compare", { label: "Leave the comparison", run: () => page.change({ columns: [] }) });
  listen(() => renderTask());
}

// ---------------------------------------------------------------- which columns

const column = (descriptor, dim = null, support_radius = null) => ({ descriptor, dim, support_radius });

function dimensions({ controls, settings }) {
  const [whole] = controls.dims.filter((dim) => dim <= 32).slice(-1);
  const shares = [whole, whole / 2, whole / 4].filter((dim) => controls.dims.includes(dim));
  return shares.map((dim) => column(settings.descriptor, dim, settings.support_radius));
}

const descriptors = ({ controls, settings }) =>
  controls.descriptors.slice(0, MOST).map((name) => column(name, null, name === settings.descriptor ? settings.support_radius : null));

function radii({ controls, settings }) {
  const { default: usual, high } = controls.support_radius;
  const sizes = [Number((0.5 * usual).toPrecision(3)), null, Number(Math.min(1.6 * usual, high).toPrecision(3))];
  return sizes.map((radius) => column(settings.descriptor, settings.dim, radius));
}

function apply(columns) {
  isDirty = false;
  page.change({ columns: columns.map(({ descriptor, dim, support_radius }) => ({ descriptor, dim, support_radius })) });
}

// ---------------------------------------------------------------- the panel

export function render(state) {
  const settings = page.chosen();
  both.checked = settings.compare_pair;
  leave.hidden = settings.columns.length === 0;
  if (!isDirty) {
    draft = settings.columns.length ? settings.columns : draft.length ? draft : descriptors(state).slice(0, 2);
    if (!list.contains(document.activeElement)) renderDraft();
  }
  renderResults(state);
  renderTask();
}

function renderDraft() {
  const { controls, unit } = page.state();
  list.replaceChildren(...draft.map((wanted, index) => {
    const change = (changes) => {
      draft = draft.map((entry, at) => (at === index ? { ...entry, ...changes } : entry));
      isDirty = true;
      renderTask();
    };
    const descriptor = element("select", { ariaLabel: `Descriptor of column ${index + 1}` });
    options(descriptor, controls.descriptors.map((name) => [name, name.toUpperCase()]));
    descriptor.value = wanted.descriptor;
    const dim = element("select", { ariaLabel: `Dimensions of column ${index + 1}` });
    const dims = [...new Set([...(wanted.descriptor === page.state().settings.descriptor ? controls.dims : []), ...(wanted.dim ? [wanted.dim] : [])])];
    options(dim, [["", "usual"], ...dims.map((value) => [String(value), String(value)])]);
    dim.value = wanted.dim === null ? "" : String(wanted.dim);
    const { size, name } = field(unit);
    const radius = element("input", { type: "text", inputMode: "decimal", placeholder: "usual", ariaLabel: `Radius of column ${index + 1}`,
      value: wanted.support_radius === null ? "" : significant(wanted.support_radius / size, 3) });
    descriptor.onchange = () => { change({ descriptor: descriptor.value, dim: null }); renderDraft(); };
    dim.onchange = () => change({ dim: dim.value === "" ? null : Number(dim.value) });
    radius.onchange = () => {
      const value = Number(radius.value.trim().replace(",", "."));
      if (radius.value.trim() === "") change({ support_radius: null });
      else if (value > 0) change({ support_radius: value * size });
      else page.refuse(`Radius of column ${index + 1} must be a number above 0, got “${radius.value}”`);
    };
    const remove = element("button", { type: "button", className: "small", textContent: "✕", ariaLabel: `Remove column ${index + 1}`, disabled: draft.length < 2 });
    remove.onclick = () => { draft = draft.filter((_, at) => at !== index); isDirty = true; renderDraft(); };
    return element("li", { className: "row" }, element("b", { textContent: String(index + 1) }), descriptor, dim,
      element("span", { className: "number" }, radius, element("span", { className: "unit", textContent: name })), remove,
      element("span", { className: "result" }));
  }));
  renderResults(page.state());
  renderTask();
}

/** What came out, beside the fields of its column. */
function renderResults({ columns }) {
  for (const [index, row] of [...list.children].entries()) {
    const found = isDirty ? undefined : columns[index];
    const text = !found ? "" : found.problem ?? (found.is_ready ? percent(found.precision) : "computing…");
    row.lastElementChild.textContent = text;
    row.lastElementChild.title = text;
    row.classList.toggle("failed", Boolean(found?.problem));
  }
}

function renderTask() {
  const task = page.state()?.status.tasks.find(({ kind }) => kind === "compare");
  news.textContent = task ? `${task.text} ${Math.round(100 * task.progress)} %` : "";
  add.disabled = draft.length >= MOST;
  go.disabled = !isDirty && page.state()?.settings.columns.length > 0;
}
