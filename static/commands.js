// What can be done by key or by name.

const commands = new Map();
const byKey = new Map();

// The scene moves its camera with these.
const OF_THE_SCENE = new Set(["w", "a", "s", "d", "q", "e", "ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"]);
const OF_CONTROLS = new Set([...OF_THE_SCENE].filter((key) => key.length > 1).concat("Home", "End", "PageUp", "PageDown", " ", "Enter"));

/**
 * Register what a person can do: `label` is for people, `keys` one key or several, `run` does it.
 *
 * A key is written as in `KeyboardEvent.key`, with `mod+` for Ctrl or Cmd and `shift+` before one that prints nothing:
 * "n", "N", "?", "mod+k", "shift+ArrowRight". Every key belongs to one command.
 */
export function command(name, { label, keys = [], run }) {
  const list = [keys].flat();
  for (const key of list) {
    if (byKey.has(key)) throw new Error(`key ${key} of ${name} belongs to ${byKey.get(key)} already`);
    byKey.set(key, name);
  }
  commands.set(name, { name, label, keys: list, run });
}

export const allCommands = () => [...commands.values()];

function keyOf(event) {
  const printable = event.key.length === 1;
  return `${event.ctrlKey || event.metaKey ? "mod+" : ""}${event.altKey ? "alt+" : ""}${event.shiftKey && !printable ? "shift+" : ""}${event.key}`;
}

/** Whether the key means something to the control that has the focus. */
function isTaken(target, key) {
  if (!target?.matches || key.startsWith("mod+")) return false;
  if (target.matches("input[type=text], input[type=search], input:not([type]), textarea, select, [contenteditable]")) return true;
  return target.matches("input, button, a, summary, [role=tab], [role=separator]") && OF_CONTROLS.has(key.replace("shift+", ""));
}

function onKey(event) {
  const key = keyOf(event);
  const found = commands.get(byKey.get(key));
  if (!found || event.defaultPrevented || document.querySelector("dialog[open]") || isTaken(event.target, key)) return;
  if (event.view !== window && OF_THE_SCENE.has(key)) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  found.run();
}

/** Listen to keys, also to those pressed while the focus is in `scene`, a frame of our own origin. */
export function listenToKeys(scene) {
  document.addEventListener("keydown", onKey);
  const inScene = () => scene.contentWindow.addEventListener("keydown", onKey, { capture: true });
  scene.addEventListener("load", inScene);
  if (scene.contentDocument?.readyState === "complete") inScene();
}
