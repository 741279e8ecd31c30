// How errors and distances are spread.

import { element } from "../lib/dom.js";

export function mount(root) {
  root.append(element("p", { className: "placeholder", textContent: "Plots linked to the scene." }));
}

export function render() {}
