// What is wrong with this pair.

import { element } from "../lib/dom.js";

export function mount(root) {
  root.append(element("p", { className: "placeholder", textContent: "Why the clouds do not register, in plain words." }));
}

export function render() {}
