// Taking the view and the results elsewhere: links, commands, files.

import { copyScene } from "../camera.js";
import { copyText, element } from "../lib/dom.js";
import { rampMarks } from "../lib/plot.js";
import { restore, viewText } from "../links.js";

const command = element("code", { id: "share-command" });
const field = element("input", { type: "text", id: "share-restore", placeholder: "Paste a link or settings", autocomplete: "off", spellcheck: false });
const problem = element("p", { className: "problem", role: "alert" });
const saved = element("p", { className: "note", id: "share-saved", role: "status" });
let page = null;

export function mount(root, given) {
  page = given;
  const button = (text, title, run) => {
    const made = element("button", { type: "button", textContent: text, title });
    made.onclick = () => run(made);
    return made;
  };
  const link = (text, title, path) => element("a", { className: "button", textContent: text, title, href: `api/${path}`, download: "" });
  const part = (title, ...children) => element("div", { className: "panel" }, element("h2", { textContent: title }), ...children);
  const withSecret = () => `${location.origin}${location.pathname}#${viewText(page.state())}`;
  const restoring = element("form", { className: "restore" }, field, element("button", { textContent: "Show" }));
  field.ariaLabel = "A link or settings to show";
  restoring.onsubmit = (event) => {
    event.preventDefault();
    show();
  };
  root.append(
    part("This view",
      element("div", { className: "buttons" },
        button("Copy settings", "Settings, tab and camera, without this viewer's address", (made) => copyText(made, viewText(page.state()))),
        button("Copy link", "For this viewer, with the secret that opens it: give it only to whom you would let in",
          (made) => copyText(made, withSecret())),
        button("Copy command", "Shows the same on another machine", (made) => copyText(made, viewCommand(page.state())))),
      element("p", { className: "note", textContent: "The link opens this view in this viewer and carries its secret. On another machine:" }),
      command,
      restoring, problem),
    part("Files",
      element("div", { className: "buttons" },
        link("Report", "One HTML file with scene, legend and figures, which opens anywhere", "report.html"),
        button("Picture", "What the scene shows now, with its legend, as PNG", savePicture),
        link("Results", "Settings, figures and poses as JSON", "results.json"),
        link("Matches, CSV", "One row a match", "matches.csv"),
        link("Matches, NPZ", "The same as NumPy arrays", "matches.npz")),
      element("p", { className: "note", textContent: "The report opens without server and network. In a script: --report report.html." })),
    part("Estimated pose",
      element("div", { className: "buttons" },
        link("Download", "Four rows of four numbers, source to target", "estimate.txt"),
        button("Save beside the source", "As a text file in the source's folder", saveBeside)),
      saved),
  );
  page.command("copy-view", { label: "Copy the settings of this view", run: () => { page.open("share"); root.querySelector("button").click(); } });
  page.command("save-picture", { label: "Save a picture of the scene", run: savePicture });
  page.command("save-report", { label: "Save a report", run: () => root.querySelector("a").click() });
}

export function render(state) {
  command.textContent = viewCommand(state);
}

/** The command that shows this view on another machine; it opens this pair alone. */
function viewCommand(state) {
  const text = new URLSearchParams(viewText(state));
  text.delete("pair");
  if (text.get("tab") === "share") text.delete("tab");
  const written = text.toString().replaceAll("%2C", ",");
  return state.open_command && written ? `${state.open_command} --state '${written}'` : state.open_command;
}

async function saveBeside() {
  saved.replaceChildren();
  try {
    const { path, exists } = await page.api("estimate/place");
    const confirm = element("button", { type: "button", textContent: exists ? "Replace it" : "Save" });
    confirm.onclick = async () => {
      try {
        await page.api("estimate/save", { method: "POST", body: { overwrite: exists } });
        saved.textContent = `Saved as ${path}`;
      } catch (error) {
        saved.textContent = error.message;
      }
    };
    saved.append(`${exists ? "There is already a file" : "It will be written to"} ${path} `, confirm);
    confirm.focus();
  } catch (error) {
    saved.textContent = error.message;
  }
}

async function show() {
  problem.textContent = "";
  try {
    await restore(page, field.value);
    field.value = "";
  } catch (error) {
    problem.textContent = error.message;
  }
}

/** Save the scene with its legend below it. */
function savePicture() {
  const state = page.state();
  const scene = document.getElementById("scene");
  const ratio = window.devicePixelRatio || 1;
  const strip = Math.round(48 * ratio);
  const canvas = copyScene(strip);
  if (!canvas || !state?.legend) return;
  paintLegend(canvas.getContext("2d"), state, { top: canvas.height - strip, width: canvas.width, height: strip, ratio: canvas.width / scene.clientWidth });
  canvas.toBlob((blob) => {
    const saved = element("a", { href: URL.createObjectURL(blob), download: `${state.source.name} to ${state.target.name}.png` });
    saved.click();
    setTimeout(() => URL.revokeObjectURL(saved.href), 10_000);
  }, "image/png");
}

function paintLegend(context, { legend, unit }, { top, width, height, ratio }) {
  const style = getComputedStyle(document.getElementById("legend"));
  const middle = top + height / 2;
  context.fillStyle = style.backgroundColor;
  context.fillRect(0, top, width, height);
  context.textBaseline = "middle";
  context.font = `${13 * ratio}px ${style.fontFamily}`;
  context.fillStyle = style.color;
  let x = 16 * ratio;
  const write = (text, at, y) => {
    context.fillText(text, at, y);
    return context.measureText(text).width;
  };
  x += write(legend.title, x, middle) + 18 * ratio;
  if (legend.ramp.length) {
    const wide = Math.min(360 * ratio, width / 3);
    legend.ramp.forEach((color, step) => {
      context.fillStyle = color;
      context.fillRect(x + (wide * step) / legend.ramp.length, middle - 13 * ratio, wide / legend.ramp.length + 1, 12 * ratio);
    });
    context.fillStyle = style.color;
    context.font = `${11 * ratio}px ${style.fontFamily}`;
    for (const [at, text] of rampMarks(legend, unit, { wanted: 5, room: 0.2 })) {
      context.textAlign = at < 1 ? "center" : "right";
      write(text, x + wide * at, middle + 9 * ratio);
    }
    context.textAlign = "left";
    context.font = `${13 * ratio}px ${style.fontFamily}`;
    x += wide + 24 * ratio;
  }
  for (const { color, label } of legend.swatches) {
    context.fillStyle = color;
    context.beginPath();
    context.arc(x + 6 * ratio, middle, 6 * ratio, 0, 2 * Math.PI);
    context.fill();
    context.fillStyle = style.color;
    x += 18 * ratio;
    x += write(label, x, middle) + 16 * ratio;
  }
}
