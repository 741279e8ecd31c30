// Settings side by side.

import { element } from "../lib/dom.js";

export function mount(root) {
  root.append(element("p", { className: "placeholder", textContent: "Descriptors and settings side by side." }));
}

export function render() {}
