// The settings at the left: what they show, and what they send.

import { $, copyText, element, options, setUnlessBusy, watchBusy } from "./lib/dom.js";
import { count, field, percent, significant } from "./lib/format.js";
import * as server from "./server.js";

const LENGTHS = ["support_radius", "lrf_radius", "voxel_size", "error_scale"];
const DEFAULTS = {
  descriptor: "cgf", dim: null, support_radius: null, lrf_radius: null, voxel_size: null, mutual: false, max_ratio: null, surest: null, line_count: 300,
  line_choice: "stratified", error_scale: null, point_size: 1, layout: "side_by_side", pose: null, reference: null,
  coloring: "error", palette: "paper",
};

// Lengths and sizes are felt as ratios, so their sliders are logarithmic.
const toSlider = (value, { low, high }) => Math.round((1000 * Math.log(value / low)) / Math.log(high / low));
const fromSlider = (position, { low, high }) => Number((low * (high / low) ** (position / 1000)).toPrecision(3));

// Few lines and many lines both need room on the slider.
const linesToSlider = (lines, { high }) => Math.round(1000 * Math.sqrt(lines / high));
const linesFromSlider = (position, { high }) => {
  const lines = high * (position / 1000) ** 2;
  return lines < 100 ? Math.round(lines) : Math.round(lines / 10) * 10;
};

export function renderControls({ controls, unit, command, ...state }) {
  const settings = server.chosen();
  // Where nothing was chosen, the server says what it took.
  const current = {
    coloring: settings.coloring, layout: settings.layout,
    pose: server.pending("pose") ?? state.pose, reference: server.pending("reference") ?? state.reference,
  };
  for (const group of document.querySelectorAll("#controls [data-setting]")) {
    const name = group.dataset.setting;
    const offered = { pose: controls.poses, reference: controls.references, coloring: controls.colorings }[name];
    for (const input of group.querySelectorAll("input")) {
      input.checked = input.value === current[name];
      input.disabled = offered !== undefined && !offered.includes(input.value);
    }
  }
  options($("descriptor"), controls.descriptors.map((name) => [name, name.toUpperCase()]));
  setUnlessBusy($("descriptor"), settings.descriptor);
  renderDims({ dims: controls.dims, dim: settings.dim ?? controls.dim });
  for (const name of LENGTHS) {
    const { size, name: unitName } = field(unit);
    const slider = $(name);
    const value = settings[name] ?? controls[name].default;
    setUnlessBusy(slider, toSlider(Math.max(value, 1e-12), controls[name]));
    setUnlessBusy($(`${name}-number`), significant(value / size, 3));
    $(`${name}-number`).nextElementSibling.textContent = unitName;
  }
  setUnlessBusy($("point_size"), toSlider(settings.point_size, controls.point_size));
  $("point_size-value").textContent = `${settings.point_size.toFixed(2)}×`;
  $("mutual").checked = settings.mutual;
  setUnlessBusy($("max_ratio"), settings.max_ratio ?? 1);
  $("max_ratio-value").textContent = settings.max_ratio === null ? "off" : settings.max_ratio.toFixed(2);
  setUnlessBusy($("surest"), settings.surest ?? 1);
  $("surest-value").textContent = settings.surest === null ? "all" : percent(settings.surest, 0);
  setUnlessBusy($("line_count"), linesToSlider(settings.line_count, controls.line_count));
  $("line_count-value").textContent = count(settings.line_count);
  setUnlessBusy($("line_choice"), settings.line_choice);
  setUnlessBusy($("palette"), settings.palette);
  $("copy").disabled = command === "";
}

function renderDims({ dims, dim }) {
  if ($("dims").dataset.dims !== String(dims)) {
    $("dims").dataset.dims = String(dims);
    $("dims").replaceChildren(...dims.map((value) => {
      const input = element("input", { type: "radio", name: "dim", value: String(value) });
      input.onchange = () => server.change({ dim: value });
      return element("label", {}, input, element("span", { textContent: String(value) }));
    }));
  }
  for (const input of $("dims").querySelectorAll("input")) input.checked = input.value === String(dim);
}

export function listenToControls(page) {
  const { change, api } = page;
  const limits = () => page.state()?.controls;
  $("controls").addEventListener("submit", (event) => event.preventDefault());
  for (const control of document.querySelectorAll("#controls input[type=range], #controls input[type=text]")) watchBusy(control);
  for (const group of document.querySelectorAll("#controls [data-setting]")) {
    group.addEventListener("change", (event) => change({ [group.dataset.setting]: event.target.value }));
  }
  for (const name of ["support_radius", "lrf_radius", "voxel_size"]) {
    // These take a computation, so they act when the slider is let go.
    $(name).addEventListener("input", () => {
      if (limits()) $(`${name}-number`).value = significant(fromSlider($(name).value, limits()[name]) / field(page.state().unit).size, 3);
    });
    $(name).addEventListener("change", () => limits() && change({ [name]: fromSlider($(name).value, limits()[name]) }));
  }
  for (const name of ["error_scale", "point_size"]) {
    $(name).addEventListener("input", () => limits() && change({ [name]: fromSlider($(name).value, limits()[name]) }));
  }
  for (const name of LENGTHS) {
    $(`${name}-number`).addEventListener("change", (event) => limits() && typed(name, event.target, page));
  }
  $("pair").addEventListener("change", (event) => change({ pair: Number(event.target.value) }));
  for (const name of ["descriptor", "line_choice", "palette"]) {
    $(name).addEventListener("change", (event) => change({ [name]: event.target.value }));
  }
  $("mutual").addEventListener("change", (event) => change({ mutual: event.target.checked }));
  $("max_ratio").addEventListener("input", (event) => {
    const ratio = Number(event.target.value);
    change({ max_ratio: ratio >= 1 ? null : ratio });
  });
  $("surest").addEventListener("input", (event) => {
    const share = Number(event.target.value);
    change({ surest: share >= 1 ? null : share });
  });
  $("line_count").addEventListener("input", (event) =>
    limits() && change({ line_count: linesFromSlider(event.target.value, limits().line_count) }));
  const resetView = () => api("camera/reset", { method: "POST" });
  $("home").addEventListener("click", resetView);
  $("cancel").addEventListener("click", () => api("cancel", { method: "POST" }));
  $("defaults").addEventListener("click", () => change({ ...DEFAULTS }));
  $("copy").addEventListener("click", () => copyText($("copy"), page.state().command));

  page.command("reset-view", { label: "Show the whole scene", keys: "r", run: resetView });
  page.command("layout", {
    label: "Side by side or overlaid", keys: "o",
    run: () => change({ layout: server.chosen().layout === "overlaid" ? "side_by_side" : "overlaid" }),
  });
  page.command("mutual", { label: "Mutual matches only, or all", keys: "m", run: () => change({ mutual: !server.chosen().mutual }) });
  page.command("surest", {
    label: "Surest tenth of the matches only, or all", run: () => change({ surest: server.chosen().surest === null ? 0.1 : null }),
  });
  for (const [coloring, label] of [["error", "error"], ["features", "features"], ["original", "original colours"],
    ["stage", "the stage that rejects"], ["distance", "distance to the picked point"], ["quality", "quality"]]) {
    page.command(`color-${coloring}`, { label: `Colour by ${label}`, run: () => change({ coloring }) });
  }
  page.command("defaults", { label: "All settings back to what suits this pair", run: () => change({ ...DEFAULTS }) });
  page.command("copy-command", { label: "Copy the command that writes these matches", run: () => copyText($("copy"), page.state().command) });
}

function typed(name, input, page) {
  const text = input.value.trim().replace(",", ".");
  const value = Number(text);
  if (text === "") page.change({ [name]: null });
  else if (Number.isFinite(value)) page.change({ [name]: value * field(page.state().unit).size });
  else page.refuse(`${input.closest(".row").querySelector(".label").textContent} must be a number, got “${text}”.`);
}
