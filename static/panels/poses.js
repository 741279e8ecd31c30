// Poses and registration.

import { element } from "../lib/dom.js";

export function mount(root) {
  root.append(element("p", { className: "placeholder", textContent: "Poses and methods of registration." }));
}

export function render() {}
