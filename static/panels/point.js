// One point and its match.

import { element } from "../lib/dom.js";

export function mount(root) {
  root.append(element("p", { className: "placeholder", textContent: "Click a point in the scene." }));
}

export function render() {}
