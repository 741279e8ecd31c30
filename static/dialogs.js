// Help on keys, and the list of commands that can be filtered and run.

import { allCommands } from "./commands.js";
import { $, element } from "./lib/dom.js";

const MAC = navigator.platform.startsWith("Mac");
const NAMES = {
  ArrowRight: "→", ArrowLeft: "←", ArrowUp: "↑", ArrowDown: "↓", " ": "Space", Escape: "Esc", shift: "Shift",
  alt: MAC ? "⌥" : "Alt", mod: MAC ? "⌘" : "Ctrl",
};
const MOUSE = [
  ["Turn the scene", ["drag"]], ["Move the scene", ["right drag"]], ["Nearer or farther", ["scroll"]],
  ["Move the camera, with the focus in the scene", ["w", "a", "s", "d", "q", "e"]],
  ["Turn the camera, with the focus in the scene", ["←", "→", "↑", "↓"]],
];

const written = (key) => key.split(/\+(?=.)/).map((part) => NAMES[part] ?? part).join(" ");
const keyList = (keys) => element("span", { className: "keys" }, ...keys.map((key) => element("kbd", { textContent: key })));
const entry = ([label, keys]) => element("li", {}, element("span", { textContent: label }), keyList(keys));

function showHelp() {
  const withKeys = allCommands().filter(({ keys }) => keys.length).map(({ label, keys }) => [label, keys.map(written)]);
  $("help-lists").replaceChildren(
    element("div", {}, element("h3", { textContent: "Keys" }), element("ul", {}, ...withKeys.map(entry))),
    element("div", {}, element("h3", { textContent: "In the scene" }), element("ul", {}, ...MOUSE.map(entry))),
  );
  $("help").showModal();
}

let found = [];
let at = 0;

function filter() {
  const words = $("commands-filter").value.toLowerCase().split(/\s+/).filter(Boolean);
  found = allCommands().filter(({ label }) => words.every((word) => label.toLowerCase().includes(word)));
  $("commands-list").replaceChildren(...found.map(({ label, keys }, index) => {
    const item = element("li", { id: `command-${index}`, role: "option" }, element("span", { textContent: label }), keyList(keys.map(written)));
    item.onclick = () => run(index);
    item.onpointermove = () => choose(index);
    return item;
  }));
  $("commands-none").hidden = found.length > 0;
  choose(0);
}

function choose(index) {
  at = index;
  for (const [other, item] of [...$("commands-list").children].entries()) item.setAttribute("aria-selected", String(other === at));
  const item = $(`command-${at}`);
  if (item) $("commands-filter").setAttribute("aria-activedescendant", item.id);
  else $("commands-filter").removeAttribute("aria-activedescendant");
  item?.scrollIntoView({ block: "nearest" });
}

function run(index) {
  $("commands").close();
  found[index]?.run();
}

function showCommands() {
  $("commands-filter").value = "";
  $("commands").showModal();
  filter();
}

export function listenToDialogs(page) {
  $("commands-filter").addEventListener("input", filter);
  $("commands-filter").addEventListener("keydown", (event) => {
    const next = { ArrowDown: at + 1, ArrowUp: at - 1 }[event.key];
    if (next !== undefined) choose((next + found.length) % Math.max(1, found.length));
    else if (event.key === "Enter") run(at);
    else return;
    event.preventDefault();
  });
  for (const dialog of document.querySelectorAll("dialog")) {
    // A click on the dialog itself is one beside its contents: on the backdrop.
    dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  }
  $("open-help").addEventListener("click", showHelp);
  $("open-commands").addEventListener("click", showCommands);
  $("theme").addEventListener("click", window.switchTheme);
  page.command("commands", { label: "Find a command", keys: ["mod+k", "/"], run: showCommands });
  page.command("help", { label: "Keys and mouse", keys: "?", run: showHelp });
  page.command("theme", { label: "Light or dark", keys: "t", run: window.switchTheme });
}
