// Links that restore a view: the settings that are not at their default, the tab and the camera, behind the address's #.

import { readCamera, restoreCamera } from "./camera.js";
import { remembered } from "./tabs.js";

/** What a link to the present view has behind its #. */
export function viewText(state) {
  const text = new URLSearchParams(state.shared);
  for (const [name, value] of [["tab", remembered().get("tab")], ["camera", readCamera()]]) if (value) text.set(name, value);
  // Commas and braces need no escaping there, and are easier to read.
  return text.toString().replaceAll("%2C", ",");
}

/** Take over what a link, or the settings from one, says; throws where it cannot be used. */
export async function restore(page, text) {
  const named = new URLSearchParams(text.slice(text.indexOf("#") + 1));
  // One that carries a camera alone leaves the settings.
  if ([...named.keys()].some((name) => !["tab", "camera"].includes(name))) {
    await page.api("state", { method: "PUT", body: { text } });
  }
  if (named.get("tab")) page.open(named.get("tab"));
  if (named.get("camera")) page.whenSettled(() => restoreCamera(named.get("camera")));
}

export function listenToLinks(page) {
  async function follow() {
    const names = [...remembered().keys()].filter((name) => name !== "tab");
    if (!names.length) return;
    const text = location.hash;
    const tab = remembered().get("tab");
    // Loading the page again shall show what was changed since.
    history.replaceState(null, "", tab ? `#tab=${tab}` : location.pathname);
    try {
      await restore(page, text);
    } catch (error) {
      page.refuse(error.message);
    }
  }
  addEventListener("hashchange", follow);
  follow();
}
