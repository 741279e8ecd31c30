// The dock below the scene: one tab a panel, as high as the person wants it.

import { $, element } from "./lib/dom.js";

const LOW = 120;
const KEPT_FOR_THE_SCENE = 200;
const HEIGHT = "cgf-viewer.dock";

/** What the address remembers beside the page itself, such as the tab that is open. */
export const remembered = () => new URLSearchParams(location.hash.slice(1));

export function remember(name, value) {
  const kept = remembered();
  kept.set(name, value);
  history.replaceState(null, "", `#${kept}`);
}

/**
 * Fill the dock: `panels` are objects with `name`, `title` and `module`.
 *
 * A module has `mount(root, page)`, called once, and `render(state)`, called at every state while its tab is shown;
 * it may have `observe(state)`, called at every state. Where it exports `needsNoClouds`, these come before there are clouds.
 */
export function makeTabs(panels, page) {
  const entries = panels.map(({ name, title, module }, index) => {
    const root = element("div", { id: `panel-${name}`, className: `tabpanel ${name}`, role: "tabpanel", tabIndex: -1, hidden: true });
    root.setAttribute("aria-labelledby", `tab-${name}`);
    const tab = element("button", { type: "button", id: `tab-${name}`, className: "tab", role: "tab", textContent: title, tabIndex: -1 });
    tab.setAttribute("aria-controls", root.id);
    tab.onclick = () => open(name);
    $("tabs").append(tab);
    $("tabpanels").append(root);
    module.mount(root, page);
    page.command(`tab-${name}`, { label: `Show ${title.toLowerCase()}`, keys: String(index + 1), run: () => open(name) });
    return { name, root, tab, module };
  });
  let shown = null;

  function open(name) {
    shown = entries.find((entry) => entry.name === name) ?? entries[0];
    for (const { root, tab } of entries) {
      const isShown = root === shown.root;
      root.hidden = !isShown;
      tab.setAttribute("aria-selected", String(isShown));
      tab.tabIndex = isShown ? 0 : -1;
    }
    shown.tab.scrollIntoView({ block: "nearest", inline: "nearest" });
    if (name !== remembered().get("tab")) remember("tab", shown.name);
    render();
  }

  function render() {
    const state = page.state();
    if (isReady(state, shown.module)) shown.module.render(state);
  }

  $("tabs").addEventListener("keydown", (event) => {
    const at = entries.indexOf(shown);
    const next = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: entries.length - 1 }[event.key];
    if (next === undefined) return;
    event.preventDefault();
    open(entries[(next + entries.length) % entries.length].name);
    shown.tab.focus();
  });
  addEventListener("hashchange", () => remembered().get("tab") && open(remembered().get("tab")));
  makeHeight(page);
  open(remembered().get("tab") ?? entries[0].name);
  return {
    open,
    render() {
      const state = page.state();
      for (const { module } of entries) if (isReady(state, module)) module.observe?.(state);
      render();
    },
  };
}

/** Panels are told of states with clouds, unless they say that they need none. */
const isReady = (state, module) => Boolean(state && (state.controls || module.needsNoClouds));

/** The edge above the dock is dragged, moved by arrow keys, or doubled by the button. */
function makeHeight(page) {
  const edge = $("dock-edge");
  const highest = () => Math.max(LOW, document.body.clientHeight - $("top").offsetHeight - $("legend").offsetHeight - KEPT_FOR_THE_SCENE);
  const current = () => $("dock").offsetHeight;

  function set(height) {
    const root = document.documentElement.style;
    if (height === null) root.removeProperty("--dock");
    else root.setProperty("--dock", `${Math.round(Math.min(Math.max(height, LOW), highest()))}px`);
    if (height === null) localStorage.removeItem(HEIGHT);
    else localStorage.setItem(HEIGHT, String(Math.round(height)));
    describe();
  }

  function describe() {
    const share = Math.round((100 * (current() - LOW)) / Math.max(1, highest() - LOW));
    edge.setAttribute("aria-valuenow", String(Math.min(Math.max(share, 0), 100)));
    $("dock-higher").setAttribute("aria-pressed", String(localStorage.getItem(HEIGHT) !== null && share > 90));
  }

  const toggle = () => set($("dock-higher").getAttribute("aria-pressed") === "true" ? null : highest());
  edge.addEventListener("pointerdown", (down) => {
    // The scene is a frame and would swallow the pointer.
    edge.setPointerCapture(down.pointerId);
    const start = current();
    const move = (event) => set(start + down.clientY - event.clientY);
    edge.addEventListener("pointermove", move);
    edge.addEventListener("lostpointercapture", () => edge.removeEventListener("pointermove", move), { once: true });
  });
  edge.addEventListener("dblclick", () => set(null));
  edge.addEventListener("keydown", (event) => {
    const step = { ArrowUp: 24, ArrowDown: -24, Home: -1e6, End: 1e6 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    set(current() + step);
  });
  $("dock-higher").addEventListener("click", toggle);
  page.command("dock-higher", { label: "Make the results higher, or as before", keys: "h", run: toggle });
  const kept = Number(localStorage.getItem(HEIGHT));
  if (kept > 0) set(kept);
  addEventListener("resize", () => {
    const height = Number(localStorage.getItem(HEIGHT));
    if (height > 0) document.documentElement.style.setProperty("--dock", `${Math.min(Math.max(height, LOW), highest())}px`);
    describe();
  });
  describe();
}
