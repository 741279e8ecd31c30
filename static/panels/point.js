// The picked point: what looks like it in the other cloud, how its neighbourhood is described, and steps through matches.

import { element, label, options, vector } from "../lib/dom.js";
import { count, length, percent } from "../lib/format.js";
import { axes, linePath } from "../lib/plot.js";
import { makeHistograms } from "./histograms.js";

const ORDERS = [["worst", "Worst first"], ["best", "Best first"], ["random", "At random"]];
const OTHER = { source: "target", target: "source" };

const parts = {
  hint: element("div", { className: "hint" },
    element("p", { textContent: "Click a point of either cloud to see its match, the runners-up and its true partner." }),
    element("p", { className: "note", textContent: "A box drawn with Shift held picks the point in its middle, and keeps only the lines that begin or end in it. N and P go through the matches one by one, Esc ends." })),
  title: element("span"),
  stage: element("small"),
  rows: element("tbody"),
  facts: element("ul", { className: "facts" }),
  plot: vector("svg", { class: "plot", role: "img", "aria-label": "How far the features of all points are from that of the picked point" }),
  order: element("select", { ariaLabel: "Order of the matches" }),
  step: element("output"),
};
const switches = {
  isolate: ["Isolate", "Draw only this match and dim all other points ( i )"],
  follow: ["Follow", "Move the camera to the point that is picked ( f )"],
  support_sphere: ["Support", "Draw the sphere that the feature describes"],
};

let page = null;
let details = null; // of the picked point, as the server told
let asked = null; // the revision that was asked for last
let histograms = null;

export function mount(root, thePage) {
  page = thePage;
  histograms = makeHistograms();
  options(parts.order, ORDERS);
  parts.order.onchange = () => page.change({ step_order: parts.order.value, picked: null });
  const button = (text, title, run) => element("button", { type: "button", className: "small", textContent: text, title, onclick: run });
  const arrow = (text, title, run) => Object.assign(button(text, title, run), { ariaLabel: title });
  const toggles = Object.entries(switches).map(([name, [text, title]]) => {
    const made = button(text, title, () => toggle(name));
    made.dataset.toggle = name;
    return made;
  });
  root.append(
    element("div", { className: "steps" },
      arrow("‹", "The match before ( p )", () => step(-1)), arrow("›", "The next match ( n )", () => step(1)), parts.order, parts.step,
      element("span", { className: "toggles" }, ...toggles)),
    parts.hint,
    element("div", { className: "panel candidates" }, element("h2", {}, parts.title, parts.stage),
      element("table", {},
        element("thead", {}, element("tr", {}, ...[["", ""], ["Point", "Row of the cloud; choose it to pick that point"], ["Distance", "Between the features"],
          ["Ratio", "The nearest's feature distance over this one's: that of the second is what the ratio test looks at"], ["Error", "How far from the true place"]]
          .map(([textContent, title]) => element("th", { textContent, title, scope: "col" })))), parts.rows)),
    element("div", { className: "panel spread" }, parts.facts, parts.plot),
    histograms.root,
  );
  new ResizeObserver(() => details && draw()).observe(root);
  page.command("next-match", { label: "Go to the next match", keys: "n", run: () => step(1) });
  page.command("previous-match", { label: "Go to the match before", keys: "p", run: () => step(-1) });
  for (const [order, text] of ORDERS) {
    page.command(`step-${order}`, { label: `Go through matches: ${text.toLowerCase()}`, run: () => { page.change({ step_order: order, picked: null }); step(1); } });
  }
  page.command("isolate", { label: "Isolate the picked match, or show all again", keys: "i", run: () => toggle("isolate") });
  page.command("follow", { label: "Follow picked points with the camera, or stay", keys: "f", run: () => toggle("follow") });
  page.command("support-sphere", { label: "Draw the support of the picked point, or hide it", run: () => toggle("support_sphere") });
  page.command("unpick", { label: "Pick nothing any more", keys: "Escape", run: unpick });
}

async function step(by) {
  try {
    await page.act("step", { by });
    page.open("point");
  } catch (error) {
    page.refuse(error.message);
  }
}

function unpick() {
  const { picked, selected } = page.chosen();
  if (picked || selected) page.change({ picked: null, selected: null });
}

const toggle = (name) => page.change({ [name]: !page.chosen()[name] });

let before = null; // what was picked in the state before

/** Open this tab when a point is picked in the scene. */
export function observe(state) {
  const now = JSON.stringify(state.settings.picked);
  if (before !== null && state.settings.picked && now !== before) page.open("point");
  before = now;
}

export function render(state) {
  const { picked, settings } = state;
  const chosen = page.chosen();
  for (const made of document.querySelectorAll("[data-toggle]")) made.setAttribute("aria-pressed", String(chosen[made.dataset.toggle]));
  document.querySelector('[data-toggle="isolate"]').disabled = !picked;
  parts.order.value = settings.step_order;
  parts.step.textContent = [
    picked?.step ? `${count(picked.step)} of ${count(picked.steps)}` : "",
    settings.selected ? `${count(settings.selected.indices.length)} points in the box` : "",
  ].filter(Boolean).join(" · ");
  parts.hint.hidden = Boolean(picked);
  for (const part of document.querySelectorAll(".tabpanel.point > .panel")) part.hidden = !picked;
  if (!picked) {
    details = null;
    return;
  }
  if (asked === state.revision) return;
  asked = state.revision;
  page.api("point").then((answer) => {
    // The next state asks for its own; there is no answer where the point is not picked any more.
    if (asked !== state.revision || !answer) return;
    details = answer;
    draw();
  }, () => { asked = null; });
}

function draw() {
  const state = page.state();
  const { unit } = state;
  parts.title.textContent = `${details.side} ${count(details.index)}`;
  parts.stage.replaceChildren(...sayStage(details));
  parts.stage.title = parts.stage.textContent;
  renderTable(state);
  parts.facts.replaceChildren(...facts(details, unit).map((text) => element("li", { textContent: text, title: text })));
  drawSpread();
  histograms.draw(details, unit);
}

function sayStage({ stage, label: text, mutual, candidates }) {
  const more = candidates.length ? ` · ${mutual ? "mutual" : "not mutual"}${candidates.length > 1 ? `, ratio ${candidates[1].ratio.toFixed(2)}` : ""}` : "";
  const passes = stage === "none";
  return [element("b", { className: passes ? "good" : "bad", textContent: text, title: passes ? "Passes all stages" : "The stage that rejects it" }), more];
}

function renderTable({ unit }) {
  const { candidates, partner, side } = details;
  const other = OTHER[side];
  const line = ({ rank, row, distance, ratio, error, right, kind }) => {
    const link = element("button", { type: "button", className: "link", textContent: count(row), title: `Pick this point of the ${other}`, onclick: () => page.change({ picked: { side: other, index: row } }) });
    return element("tr", { className: kind },
      element("td", { textContent: rank === null ? "–" : count(rank), title: rank === 1 ? "The match" : "" }),
      element("td", {}, link),
      element("td", { textContent: distance === null ? "–" : distance.toFixed(3) }),
      element("td", { textContent: ratio === null ? "" : ratio.toFixed(2) }),
      element("td", { className: right === null ? "" : right ? "good" : "bad", textContent: error === null ? "–" : `${right ? "✓" : "✗"} ${length(error, unit)}`, title: right === null ? "" : right ? "right" : "wrong" }));
  };
  const listed = candidates.map(({ row, feature_distance, ratio, error, right }, index) => line({
    rank: index + 1, row, distance: feature_distance, ratio, error, right,
    kind: [index === 0 ? "match" : "", row === partner?.row ? "partner" : ""].join(" "),
  }));
  if (partner && !candidates.some(({ row }) => row === partner.row)) {
    const nearest = candidates[0]?.feature_distance;
    listed.push(line({
      rank: partner.rank, row: partner.row, distance: partner.feature_distance, error: partner.gap, right: true, kind: "partner beyond",
      ratio: partner.feature_distance && nearest !== undefined ? nearest / partner.feature_distance : null,
    }));
  }
  parts.rows.replaceChildren(...listed);
}

function facts({ quality, surer, candidates, partner, features, nearer_matches, modes, modes_apart, side, stage }, unit) {
  const known = candidates.some(({ error }) => error !== null);
  const found = [];
  if (!candidates.length) found.push(stage === "no_frame" ? "No feature: too few neighbours for a local frame." : "No feature.");
  else if (partner?.rank === 1) found.push("The match is the true partner.");
  else if (partner?.rank) found.push(`The true partner is number ${count(partner.rank)} of ${count(features)}.`);
  else if (partner) found.push("The true partner has no feature.");
  else if (known) found.push("No true partner: the other cloud ends before.");
  if (nearer_matches !== null) found.push(`Match nearer than ${percent(1 - nearer_matches, 0)} of the ${side}'s.`);
  if (quality !== null) found.push(`Quality ${quality.toFixed(2)}: higher than of ${percent(1 - surer, 0)} of the ${side}'s.`);
  if (modes > 1) found.push(`${modes === 100 ? "100 or more" : modes} places look alike, ${length(modes_apart, unit)} or more apart.`);
  else if (modes === 1) found.push("No other place looks alike.");
  return found;
}

function drawSpread() {
  const { distribution, candidates, partner } = details;
  const plot = distribution && axes(parts.plot, {
    x: { range: [distribution.edges[0], distribution.edges.at(-1)], log: true, title: "feature distance", ticks: logTicks(distribution.edges[0], distribution.edges.at(-1)) },
    y: { range: [0, 1], ticks: [], title: "" }, left: 8,
  });
  if (!plot) {
    parts.plot.replaceChildren();
    return;
  }
  const { edges } = distribution;
  const { x, box, parts: drawn } = plot;
  const area = (counts) => {
    const highest = Math.max(1, ...counts);
    const xs = counts.flatMap((_, index) => [edges[index], edges[index + 1]]);
    return linePath(plot, xs, counts.flatMap((value) => [value / highest, value / highest]));
  };
  const all = area(distribution.points);
  drawn.push(vector("path", { class: "all", d: `${all}L${x(edges.at(-1))} ${box.bottom}L${x(edges[0])} ${box.bottom}Z` }, vector("title", {}, "To every point of the other cloud")));
  for (const [name, text] of [["wrong", "Of all wrong matches"], ["right", "Of all right matches"]]) {
    if (!distribution[name].some((value) => value > 0)) continue;
    drawn.push(vector("path", { class: name, d: area(distribution[name]) }, vector("title", {}, text)));
    drawn.push(label(box.left + 4, box.top + (name === "right" ? 9 : 21), name, "start", name));
  }
  const mark = (value, name, text) => {
    drawn.push(vector("line", { class: `mark ${name}`, x1: x(value), x2: x(value), y1: box.top, y2: box.bottom }, vector("title", {}, text)));
    return label(x(value) + 3, box.top + (name === "partner" ? 20 : 9), text, "start", name);
  };
  const texts = [];
  if (candidates.length && candidates[0].feature_distance > 0) texts.push(mark(candidates[0].feature_distance, "match", "match"));
  if (partner?.feature_distance && partner.rank !== 1) texts.push(mark(partner.feature_distance, "partner", "true partner"));
  parts.plot.replaceChildren(...drawn, ...texts);
  for (const text of texts) {
    const { x: start, width } = text.getBBox();
    if (start + width > box.right) {
      text.setAttribute("x", Number(text.getAttribute("x")) - 6);
      text.setAttribute("text-anchor", "end");
    }
  }
}

function logTicks(low, high) {
  const ticks = [];
  for (let magnitude = Math.floor(Math.log10(low)); 10 ** magnitude <= high; magnitude += 1) {
    for (const digit of [1, 2, 5]) {
      const value = digit * 10 ** magnitude;
      if (value >= low && value <= high) ticks.push([value, String(Number(value.toPrecision(2)))]);
    }
  }
  return ticks;
}
