// Building and filling elements.

export const $ = (id) => document.getElementById(id);

export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** An SVG element. */
export function vector(tag, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

/** Text in an SVG; `anchor` is start, middle or end. */
export function label(x, y, text, anchor, className = "") {
  return vector("text", { x, y, "text-anchor": anchor, ...(className && { class: className }) }, text);
}

/** The entries of a select, as pairs of value and text; it is left alone where they are the same already. */
export function options(select, entries) {
  const key = JSON.stringify(entries);
  if (select.dataset.entries === key) return;
  select.dataset.entries = key;
  select.replaceChildren(...entries.map(([value, text]) => element("option", { value, textContent: text })));
}

/** Do not move a control under the hand of the person who uses it. */
export function setUnlessBusy(control, value) {
  if (control.dataset.busy !== "true") control.value = value;
}

/** Note when a person is at a slider or field, for `setUnlessBusy`. */
export function watchBusy(control) {
  control.addEventListener("input", () => { control.dataset.busy = "true"; });
  for (const end of ["change", "blur"]) control.addEventListener(end, () => { control.dataset.busy = "false"; });
}

/** A list of names and values; `rows` are pairs of texts. */
export function pairs(list, rows) {
  list.replaceChildren(...rows.flatMap(([name, value]) => [
    element("dt", { textContent: name }), element("dd", { textContent: value, title: value }),
  ]));
}

/** Copy a text, and say so on the button for a moment. */
export async function copyText(button, text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // Browsers allow the clipboard on this machine or over https only.
    window.prompt("To be copied:", text);
    return;
  }
  const { textContent } = button;
  if (textContent === "Copied") return;
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = textContent; }, 1500);
}
