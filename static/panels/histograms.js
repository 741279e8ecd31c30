// The spherical histograms of the picked point and of its match or true partner, and their difference, as pictures.

import { element } from "../lib/dom.js";
import { count, length, percent } from "../lib/format.js";

const SHELLS = 17;
const RINGS = 11;
const SECTORS = 12;
const GAP = 3;
const LARGEST_CELL = 5;
const PADDING = 34;

const CAPTIONS = ["point", "other", "difference"];

/** Both ends of the scale of differences, and the colour of bins, as red, green and blue; told apart by colour-blind eyes. */
const COLORS = {
  dark: { ground: [32, 39, 51], full: [240, 226, 178], middle: [150, 84, 60], less: [88, 166, 255], more: [255, 158, 64] },
  light: { ground: [238, 241, 245], full: [60, 16, 62], middle: [222, 138, 92], less: [16, 92, 190], more: [190, 84, 0] },
};

/** The part of the panel with the pictures: `root`, and `draw(details, unit)`. */
export function makeHistograms() {
  const strips = Object.fromEntries(CAPTIONS.map((name) => [name, {
    caption: element("p", { className: "caption" }), canvas: element("canvas", { role: "img" }),
  }]));
  const choice = element("select", { ariaLabel: "Compare with" },
    element("option", { value: "match", textContent: "Beside its match" }), element("option", { value: "partner", textContent: "Beside its partner" }));
  const said = element("p", { className: "readout" });
  const nothing = element("p", { className: "note" });
  const root = element("div", { className: "panel histograms" },
    element("div", { className: "beside" }, choice, said),
    element("div", { className: "strips" }, ...CAPTIONS.flatMap((name) => [strips[name].caption, strips[name].canvas])), nothing);
  let shown = null;

  choice.onchange = () => shown && draw(shown.details, shown.unit);
  for (const { canvas } of Object.values(strips)) {
    canvas.addEventListener("pointermove", (event) => read(event, canvas));
    canvas.addEventListener("pointerleave", () => explain());
  }
  const again = () => shown && draw(shown.details, shown.unit);
  new MutationObserver(again).observe(document.documentElement, { attributeFilter: ["data-theme"] });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);

  function draw(details, unit) {
    const { point_histogram: point, match_histogram: match, partner_histogram: partner } = details;
    choice.options[1].disabled = !partner;
    if (choice.value === "partner" && !partner) choice.value = "match";
    const isPartner = choice.value === "partner";
    const other = isPartner ? partner : match;
    const turned = other && turn(other.bins, other.turn);
    shown = { details, unit, bins: { point: point?.bins ?? null, other: turned, difference: null } };
    nothing.textContent = point ? "" : "This descriptor, or this point, has no spherical histogram.";
    nothing.hidden = Boolean(point);
    root.querySelector(".strips").hidden = !point;
    if (!point) {
      said.textContent = "";
      return;
    }
    // The network sees square roots, in which few neighbours count too.
    const roots = (bins) => bins.map(Math.sqrt);
    const highest = Math.max(...roots(point.bins), ...(turned ? roots(turned) : [0]));
    const difference = turned && roots(point.bins).map((value, index) => Math.sqrt(turned[index]) - value);
    const largest = difference ? Math.max(1e-9, ...difference.map(Math.abs)) : 1;
    shown.bins.difference = difference;
    strips.point.caption.textContent = `The point: ${count(point.neighbors)} neighbours`;
    const degrees = other ? ((other.turn * 30 + 180) % 360) - 180 : 0;
    strips.other.caption.textContent = other
      ? `Its ${isPartner ? "true partner" : "match"}: ${count(other.neighbors)} neighbours${degrees ? `, turned by ${degrees}° to fit` : ""}` : "No match";
    strips.other.caption.title = "The feature treats the 12 sectors alike, so turns by 30° are no difference to it.";
    strips.difference.caption.replaceChildren(...(other ? ["Difference: ", element("i", { className: "less", textContent: "less" }), " or ", element("i", { className: "more", textContent: "more" }), ` in the ${isPartner ? "partner" : "match"}`] : []));
    const colors = COLORS[isDark() ? "dark" : "light"];
    paint(strips.point.canvas, roots(point.bins), (value) => sequential(value / highest, colors));
    paint(strips.other.canvas, turned && roots(turned), (value) => sequential(value / highest, colors));
    paint(strips.difference.canvas, difference, (value) => diverging(value / largest, colors));
    for (const name of CAPTIONS) strips[name].canvas.ariaLabel = strips[name].caption.textContent;
    explain();
  }

  /** Pixels of a bin: as large as the panel has room beside or below its other parts, as the style sheet has them. */
  function cell() {
    const { clientWidth: width, clientHeight: height } = root.parentElement;
    const wide = width - PADDING - (width > 900 ? 250 + 200 : width > 680 ? 250 : 0);
    const fits = Math.min((wide - (SECTORS - 1) * GAP) / (SECTORS * SHELLS), (height - 118) / (3 * RINGS));
    return Math.min(Math.max(Math.floor(fits), 2), LARGEST_CELL);
  }

  function paint(canvas, values, color) {
    const size = cell();
    canvas.hidden = !values;
    if (!values) return;
    const sectorWidth = SHELLS * size + GAP;
    canvas.width = SECTORS * sectorWidth - GAP;
    canvas.height = RINGS * size;
    canvas.dataset.size = String(size);
    const context = canvas.getContext("2d");
    values.forEach((value, index) => {
      const [shell, ring, sector] = [index % SHELLS, Math.floor(index / SHELLS) % RINGS, Math.floor(index / (SHELLS * RINGS))];
      context.fillStyle = color(value);
      context.fillRect(sector * sectorWidth + shell * size, ring * size, size, size);
    });
  }

  function explain() {
    said.textContent = "12 sectors around the normal; shells rightwards, angles from the normal downwards.";
  }

  function read(event, canvas) {
    const size = Number(canvas.dataset.size);
    const sectorWidth = SHELLS * size + GAP;
    const scale = canvas.width / canvas.clientWidth;
    const [x, y] = [event.offsetX * scale, event.offsetY * scale];
    const sector = Math.min(Math.floor(x / sectorWidth), SECTORS - 1);
    const shell = Math.min(Math.floor((x - sector * sectorWidth) / size), SHELLS - 1);
    const ring = Math.min(Math.floor(y / size), RINGS - 1);
    const index = shell + SHELLS * (ring + RINGS * sector);
    const { details: { shells }, unit, bins } = shown;
    const angle = (step, steps, whole) => Math.round((step * whole) / steps);
    const where = `${30 * sector - 180} to ${30 * sector - 150}° around, ${angle(ring, RINGS, 180)} to ${angle(ring + 1, RINGS, 180)}° off the normal, ${length(shells[shell], unit)} to ${length(shells[shell + 1], unit)} away`;
    const values = `${percent(bins.point[index], 2)}${bins.other ? `, beside it ${percent(bins.other[index], 2)}` : ""}`;
    said.textContent = `${where}: ${values}`;
  }

  return { root, draw };
}

/** The theme, read off the colour of the text. */
const isDark = () => getComputedStyle(document.body).color.match(/\d+/g).slice(0, 3).reduce((sum, value) => sum + Number(value), 0) > 382;

/** Bins with the sectors moved on by `sectors`. */
function turn(bins, sectors) {
  const by = sectors * SHELLS * RINGS;
  return bins.map((_, index) => bins[(index - by + bins.length) % bins.length]);
}

const mixed = (from, to, share) => from.map((value, channel) => value + (to[channel] - value) * share);
const css = (color) => `rgb(${color.map(Math.round).join(" ")})`;

function sequential(share, { ground, middle, full }) {
  if (share <= 0) return css(ground);
  return css(share < 0.5 ? mixed(mixed(ground, middle, 0.25), middle, share * 2) : mixed(middle, full, share * 2 - 1));
}

const diverging = (share, { ground, less, more }) => css(mixed(ground, share < 0 ? less : more, Math.min(1, Math.abs(share)) ** 0.8));
