// The top bar, and what is written over the scene: status, pair, messages.

import { $, element, options } from "./lib/dom.js";
import { count } from "./lib/format.js";
import * as server from "./server.js";

const dismissed = new Set();

export function renderStatus() {
  if (server.offline()) {
    $("status").dataset.phase = "failed";
    $("status-text").textContent = "Not connected: has cgf-viewer stopped?";
    $("cancel").hidden = true;
    return;
  }
  const { phase, text, progress, elapsed_s } = server.state().status;
  $("status").dataset.phase = phase;
  const working = phase === "working";
  // Only the text is read aloud.
  $("status-text").textContent = text;
  $("status-share").textContent = working && progress > 0 ? `${Math.round(100 * progress)} %`
    : phase === "ready" && elapsed_s !== null ? `${elapsed_s.toFixed(2)} s` : "";
  $("cancel").hidden = !working;
  $("progress").style.width = `${100 * (working ? progress : 1)}%`;
  $("progress").classList.toggle("done", !working);
}

export function renderNotices() {
  const state = server.state();
  // An error may happen again, so closing it is for this time only.
  const messages = (state?.messages ?? []).map(({ level, text }) => {
    const key = level === "error" ? `${state.revision} ${text}` : text;
    return { level, text, key, close: () => dismissed.add(key) };
  });
  if (server.refused()) {
    const text = `${server.refused().replace(/\.?$/, ".")} Nothing was changed.`;
    messages.unshift({ level: "error", text, key: null, close: () => server.refuse(null) });
  }
  $("notices").replaceChildren(...messages.filter(({ key }) => !dismissed.has(key)).map(({ level, text, close }) => {
    const button = element("button", { type: "button", textContent: "✕", ariaLabel: "Close this message" });
    button.onclick = () => {
      close();
      renderNotices();
    };
    const notice = element("div", { className: "notice" }, element("p", { textContent: text }), button);
    notice.dataset.level = level;
    return notice;
  }));
}

export function renderPair() {
  const state = server.state();
  const several = state.pairs.length > 1;
  $("pair").hidden = !several;
  $("pair-names").hidden = several;
  if (several) {
    options($("pair"), state.pairs.map((name, index) => [String(index), name]));
    $("pair").value = String(state.settings.pair);
  }
  if (!state.source) {
    $("pair-names").textContent = state.pairs[state.settings.pair];
    return;
  }
  const arrow = element("span", { className: "arrow", textContent: "→" });
  $("pair-names").replaceChildren(state.source.name, arrow, state.target.name);
  document.title = `${state.source.name} → ${state.target.name} · cgf-viewer`;
  $("model").textContent = state.model.reason;
  $("model").title = state.model.reason;
  const apart = state.settings.layout === "side_by_side" && !state.columns.length;
  for (const side of ["source", "target"]) {
    $(`tag-${side}`).hidden = !apart;
    const { points, shown, prepared } = state[side];
    $(`tag-${side}`).textContent = `${side === "source" ? "Source" : "Target"} · ${count(shown)} points`
      + `${shown < points ? ` of ${count(points)}` : ""}${prepared < shown ? `, ${count(prepared)} described` : ""}`;
    if (state.previewed !== null) $(`tag-${side}`).textContent = `Preview from ${count(state.previewed)} points`;
    $(`tag-${side}`).title = "Points drawn; each has the colour of the nearest point that is described";
  }
}
