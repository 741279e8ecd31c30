// The camera of this window's scene, as links carry it. It is the scene's own, so it is asked for there.

import { $ } from "./lib/dom.js";

const viewer = () => $("scene").contentWindow?.__viserMutable;

/** Position and target in the frame of the scene, or null before there is one. */
export function readCamera() {
  const control = viewer()?.cameraControl;
  if (!control) return null;
  const { position, target } = JSON.parse(control.toJSON());
  return [...position, ...target].map((value) => Number(value.toFixed(3))).join(",");
}

const HELD_MS = 20_000;

/**
 * Look from where `text` says.
 *
 * The server sends each tab its first view, which may come after this, so it is held against that until a hand is at the
 * page.
 */
export function restoreCamera(text) {
  const values = text.split(",").map(Number);
  if (values.length !== 6 || !values.every(Number.isFinite)) return;
  let end = null;
  const letGo = () => { end = 0; };
  const look = () => {
    const { cameraControl, nodeRefFromName } = viewer() ?? {};
    if (cameraControl && nodeRefFromName["/source"]) {
      if (end === null) {
        end = performance.now() + HELD_MS;
        for (const place of [window, $("scene").contentWindow]) {
          for (const touch of ["pointerdown", "keydown", "wheel"]) place.addEventListener(touch, letGo, { once: true, capture: true });
        }
      }
      if (performance.now() > end) return;
      if (readCamera() !== text) cameraControl.setLookAt(...values, false);
    }
    setTimeout(look, 100);
  };
  look();
}

/** The scene as it is shown, on the ground it has there, as a canvas with room for `extra` more pixels below; or null. */
export function copyScene(extra) {
  const shown = viewer()?.canvas;
  if (!shown) return null;
  const { width, height } = shown;
  const copy = Object.assign(document.createElement("canvas"), { width, height: height + extra });
  const context = copy.getContext("2d");
  const grounds = getComputedStyle(shown).backgroundImage.match(/rgba?\([^)]*\)/g) ?? ["black"];
  const ground = context.createRadialGradient(width / 2, 0.42 * height, 0, width / 2, 0.42 * height, 0.6 * width);
  grounds.forEach((color, index) => ground.addColorStop(index / Math.max(1, grounds.length - 1), color));
  context.fillStyle = ground;
  context.fillRect(0, 0, width, height);
  context.drawImage(shown, 0, 0);
  return copy;
}
