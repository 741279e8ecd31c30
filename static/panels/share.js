// Taking the result elsewhere.

import { element } from "../lib/dom.js";

export function mount(root) {
  root.append(element("p", { className: "placeholder", textContent: "Links, files and reports." }));
}

export function render() {}
