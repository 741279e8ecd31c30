// Opening other clouds: by path, from a file dialog, dropped onto the page, or again from those opened last.

import { $, element } from "./lib/dom.js";

const SLOTS = ["source", "target", "gt"];
const POSES = /\.(txt|log|csv)$|pose|trans|(^|[^a-z])gt([^a-z]|$)/i;
const CLOUDS = /\.(ply|pcd|obj|stl|npz|xyz|pts|asc)$/i;

// What each slot holds: a path on the viewer's machine, or a file of the browser's.
const files = { source: null, target: null, gt: null };
let page = null;

const field = (slot) => $(`load-${slot}`);
const isFilled = (slot) => files[slot] !== null || field(slot).value.trim() !== "";

function put(slot, file) {
  files[slot] = file;
  field(slot).value = file.name;
}

function clear() {
  for (const slot of SLOTS) {
    files[slot] = null;
    field(slot).value = "";
    $(`load-${slot}-file`).value = "";
  }
  $("load-problem").textContent = "";
}

/** Clouds go where there is room, a pose to the poses. */
function take(dropped) {
  const list = [...dropped];
  const isPose = (file) => !CLOUDS.test(file.name) && POSES.test(file.name);
  const clouds = list.filter((file) => !isPose(file));
  if (clouds.length > 1) clear();
  for (const file of clouds.slice(0, 2)) put(isFilled("source") && !isFilled("target") ? "target" : "source", file);
  const pose = list.find(isPose);
  if (pose) put("gt", pose);
}

async function show() {
  if ($("load").open) return;
  $("load-problem").textContent = "";
  $("load").showModal();
  field("source").focus();
  const recent = await page.api("recent").catch(() => []);
  $("load-recent").hidden = recent.length === 0;
  $("load-recent-list").replaceChildren(...recent.map(({ source, target, gt }) => {
    const [names, folder] = [[source, target].map((path) => path.split("/").at(-1)).join(" → "), source.split("/").slice(0, -1).join("/")];
    const button = element("button", { type: "button", title: [source, target, gt].filter(Boolean).join("\n") },
      element("span", { textContent: names }), element("small", { textContent: folder }));
    button.onclick = () => {
      clear();
      field("source").value = source;
      field("target").value = target;
      field("gt").value = gt ?? "";
      open();
    };
    return element("li", {}, button);
  }));
}

/** The path of what a slot holds; a file of the browser's is sent to the viewer first. */
async function pathOf(slot) {
  const file = files[slot];
  if (file === null) return field(slot).value.trim() || null;
  $("load-status").textContent = `Sending ${file.name}`;
  return (await page.api(`uploads/${encodeURIComponent(file.name)}`, { method: "PUT", content: file })).path;
}

async function open() {
  const button = $("load-open");
  button.disabled = true;
  $("load-problem").textContent = "";
  try {
    const paths = {};
    for (const slot of SLOTS) paths[slot] = await pathOf(slot);
    if (!paths.source || !paths.target) throw new Error("Name two clouds, a source and a target.");
    $("load-status").textContent = "Reading the clouds";
    await page.api("open", { method: "POST", body: { ...paths, drop_invalid: $("load-drop-invalid").checked } });
    $("load").close();
    clear();
  } catch (error) {
    $("load-problem").textContent = error.message;
  } finally {
    button.disabled = false;
    $("load-status").textContent = "";
  }
}

function swap() {
  [files.source, files.target] = [files.target, files.source];
  [field("source").value, field("target").value] = [field("target").value, field("source").value];
}

/** Let files be dropped anywhere on the page, the scene's frame included. */
function listenToDrops(place) {
  const hasFiles = (event) => event.dataTransfer?.types.includes("Files");
  place.addEventListener("dragover", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    $("drop-hint").hidden = false;
  });
  place.addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) $("drop-hint").hidden = true;
  });
  place.addEventListener("drop", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    $("drop-hint").hidden = true;
    const dropped = [...event.dataTransfer.files];
    show();
    take(dropped);
  });
}

export function listenToLoading(given) {
  page = given;
  for (const slot of SLOTS) {
    field(slot).addEventListener("input", () => { files[slot] = null; });
    $(`load-${slot}-choose`).addEventListener("click", () => $(`load-${slot}-file`).click());
    $(`load-${slot}-file`).addEventListener("change", (event) => event.target.files.length && put(slot, event.target.files[0]));
  }
  $("load-form").addEventListener("submit", (event) => {
    event.preventDefault();
    open();
  });
  $("load-swap").addEventListener("click", swap);
  $("open-load").addEventListener("click", show);
  page.command("load", { label: "Open other clouds", keys: "l", run: show });
  listenToDrops(document);
  const inScene = () => listenToDrops($("scene").contentDocument);
  $("scene").addEventListener("load", inScene);
  if ($("scene").contentDocument?.readyState === "complete") inScene();
}
