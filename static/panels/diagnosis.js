// What is wrong with this pair: the verdict, and a card for each finding with its evidence and its remedy.

import { element } from "../lib/dom.js";
import { length, percent, quantity, significant } from "../lib/format.js";

const STAGES = { input: "Input", overlap: "Overlap", radius: "Radius", features: "Features", matching: "Matching", estimator: "Estimator" };
const SIGNS = { problem: "✕", caution: "!", fine: "✓" };
const OUTCOMES = { registered: "fine", doubtful: "caution", failed: "problem" };
const CORRECTIONS = { unit: "m", source_scale: 1, normals: "stored", flip_normals: "none" };

const sign = element("span", { className: "sign", ariaHidden: "true" });
const verdict = element("p", { id: "verdict", textContent: "Looking for what is wrong…" });
const basis = element("span", { className: "basis" });
const corrections = element("p", { className: "corrections", hidden: true });
const cards = element("div", { className: "cards" });
const fine = element("details", { className: "fine-findings", hidden: true }, element("summary"), element("div", { className: "cards" }));
const actions = element("div", { className: "buttons" });
const badge = element("span", { className: "badge", hidden: true });

/** A pair that cannot even be shown is diagnosed as well. */
export const needsNoClouds = true;

let page = null;
let held = null; // the diagnosis shown, as the server gave it
let asked = null; // its number

export function mount(root, given) {
  page = given;
  root.append(element("div", { className: "verdict" }, sign, element("div", { className: "says" }, verdict, basis), actions), corrections, cards, fine);
  document.getElementById("tab-diagnosis").append(badge);
}

/** The tab says how many problems there are, whichever tab is shown. */
export function observe({ diagnosis }) {
  badge.hidden = !diagnosis?.problems;
  badge.textContent = diagnosis?.problems ?? "";
  badge.title = `${diagnosis?.problems} ${diagnosis?.problems === 1 ? "problem" : "problems"} found`;
}

export function render(state) {
  renderCorrections(state.settings);
  const root = cards.parentElement;
  const isThere = state.diagnosis !== null;
  root.classList.toggle("stale", !isThere && held !== null);
  root.setAttribute("aria-busy", String(!isThere));
  if (isThere && asked !== state.diagnosis.number) {
    asked = state.diagnosis.number;
    page.api("diagnosis").then((found) => { held = found; show(page.state()); }, () => { asked = null; });
  } else if (isThere && held?.number === state.diagnosis.number) {
    show(state);
  }
}

function show(state) {
  const worst = held.findings.some((finding) => finding.severity === "problem") ? "problem" : OUTCOMES[held.outcome];
  sign.textContent = SIGNS[worst];
  sign.dataset.severity = worst;
  verdict.textContent = held.verdict;
  basis.textContent = held.is_judged_by_truth ? "Judged by the true pose." : "No true pose is known: judged by the matches themselves.";
  const wrong = held.findings.filter((finding) => finding.severity !== "fine");
  const good = held.findings.filter((finding) => finding.severity === "fine");
  // What mends the main problem is within reach without scrolling.
  actions.replaceChildren(...(wrong[0]?.severity === "problem" ? buttonsOf(wrong[0], state) : []));
  cards.replaceChildren(...wrong.map((finding) => card(finding, state)));
  fine.hidden = good.length === 0;
  fine.firstChild.textContent = `${good.length} ${good.length === 1 ? "check" : "checks"} found nothing wrong`;
  fine.lastChild.replaceChildren(...good.map((finding) => card(finding, state)));
  if (wrong.length === 0) fine.open = true;
}

function card(finding, state) {
  const { kind, severity, stage, sentence, evidence, remedy, confidence } = finding;
  const { unit } = state;
  const rows = evidence.map(({ name, value, quantity: kindOfNumber, threshold, rule, estimated, holds }) => {
    const says = `${quantity(value, kindOfNumber, unit)}${estimated ? " (estimated)" : ""}`;
    const limit = threshold === null ? "" : `${rule} ${quantity(threshold, kindOfNumber, unit)}`;
    const row = element("tr", { className: holds ? "" : "off" }, element("th", { scope: "row", textContent: name }),
      element("td", { textContent: says }), element("td", { className: "limit", textContent: limit }));
    if (!holds) row.title = `Should be ${limit}`;
    return row;
  });
  const buttons = element("div", { className: "buttons" }, ...buttonsOf(finding, state));
  const made = element("article", { className: "card" },
    element("p", { className: "title" }, element("span", { className: "sign", textContent: SIGNS[severity], title: severity }), element("span", { textContent: sentence })),
    element("p", { className: "stage", textContent: STAGES[stage], title: `Confidence ${percent(confidence, 0)}` }),
    element("table", {}, element("tbody", {}, ...rows)));
  if (remedy && severity !== "fine") made.append(element("p", { className: "remedy", textContent: remedy }));
  if (buttons.childElementCount) made.append(buttons);
  made.dataset.severity = severity;
  made.dataset.kind = kind;
  return made;
}

/** Mend it, and show where it is. */
function buttonsOf({ kind, severity, changes, options, has_place: hasPlace }, { settings, unit }) {
  const made = [];
  if (Object.keys(changes).length && severity !== "fine") {
    const apply = element("button", { type: "button", className: "apply", textContent: `Apply: ${changesText(changes, unit)}`, title: options ? `On the command line: ${options}` : "" });
    apply.onclick = () => page.change({ ...changes, highlight: null });
    made.push(apply);
  }
  if (hasPlace) {
    const isShown = settings.highlight === kind;
    const points = element("button", { type: "button", className: "points", textContent: isShown ? "Hide points" : "Show points" });
    points.setAttribute("aria-pressed", String(isShown));
    points.onclick = () => page.change({ highlight: isShown ? null : kind });
    made.push(points);
  }
  return made;
}

/** What was mended in the clouds has no control elsewhere: name it, and let it be undone. */
function renderCorrections(settings) {
  const changed = Object.keys(CORRECTIONS).filter((name) => settings[name] !== CORRECTIONS[name]);
  corrections.hidden = changed.length === 0;
  corrections.replaceChildren("In force:", ...changed.map((name) => {
    const undo = element("button", { type: "button", className: "small", textContent: `${changeText(name, settings[name])} ✕`, title: "Undo this" });
    undo.onclick = () => page.change({ [name]: CORRECTIONS[name] });
    return undo;
  }));
}

const changesText = (changes, unit) => Object.entries(changes).map(([name, value]) => changeText(name, value, unit)).join(", ");

function changeText(name, value, unit) {
  const lengths = { support_radius: "support radius", min_radius: "smallest radius", lrf_radius: "frame radius", voxel_size: "voxel size" };
  if (name in lengths) return value === null ? `usual ${lengths[name]}` : `${lengths[name]} ${length(value, unit)}`;
  return {
    unit: () => `unit ${value}`,
    source_scale: () => `source × ${significant(value, 6)}`,
    normals: () => (value === "estimated" ? "estimate normals anew" : "normals as stored"),
    flip_normals: () => (value === "none" ? "normals as they are" : `turn round normals of ${value === "both" ? "both clouds" : `the ${value}`}`),
    mutual: () => (value ? "mutual matches only" : "all matches"),
    max_ratio: () => (value === null ? "no ratio limit" : `ratio limit ${value}`),
    surest: () => (value === null ? "all matches, not the surest alone" : `surest ${percent(value, 0)}`),
    model: () => `model ${value}`,
  }[name]();
}
