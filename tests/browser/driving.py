"""What tests of the page share: a real Chromium with software WebGL, and a page open in it."""

import json
import urllib.request
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from playwright.sync_api import Browser, ConsoleMessage, Frame, Page, expect

from tests.app.scenes import LONG_S
from tests.app.serving import Served

USUAL_SIZE = (1440, 900)


@dataclass
class Viewer:
    """An open page of a running server."""

    served: Served
    page: Page
    complaints: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    """Addresses that the page and its scene have asked for."""

    @property
    def frame(self) -> Frame:
        return next(frame for frame in self.page.frames if "/viewer" in frame.url)

    def state(self) -> dict[str, Any]:
        with urllib.request.urlopen(self.served.url + "api/state", timeout=LONG_S) as answer:
            state: dict[str, Any] = json.load(answer)
        return state

    def settle(self) -> dict[str, Any]:
        """The state once nothing is left to compute."""
        assert self.served.session.wait_until_idle(LONG_S)
        return self.state()

    def pixels(self) -> Counter[tuple[int, int, int]]:
        """Colours of the fully drawn pixels of the scene, with their counts."""
        counted = self.frame.evaluate(_PIXELS)
        return Counter({tuple(int(hexed[at : at + 2], 16) for at in (0, 2, 4)): count for hexed, count in counted})

    def pixels_after(self, before: Counter[tuple[int, int, int]]) -> Counter[tuple[int, int, int]]:
        """The same, once they differ from `before` and have come to rest."""
        self.frame.evaluate(_UNTIL_CHANGED, hash_of(before))
        return self.pixels()


# Reads the canvas as it is shown; the parts that the clouds leave open are transparent there.
_READ = """
  const read = () => {
    const shown = window.__viserMutable.canvas;
    const copy = new OffscreenCanvas(shown.width, shown.height);
    const context = copy.getContext("2d", { willReadFrequently: true });
    context.drawImage(shown, 0, 0);
    const { data } = context.getImageData(0, 0, copy.width, copy.height);
    const counts = new Map();
    for (let at = 0; at < data.length; at += 4) {
      if (data[at + 3] !== 255) continue;
      const color = (data[at] << 16) | (data[at + 1] << 8) | data[at + 2];
      counts.set(color, (counts.get(color) ?? 0) + 1);
    }
    return counts;
  };
  const digest = (counts) => {
    let sum = 0;
    for (const [color, count] of counts) sum = (sum + (color % 99991) * count) % 2147483647;
    return sum;
  };
"""
_PIXELS = f"""() => {{ {_READ}
  return [...read()].map(([color, count]) => [color.toString(16).padStart(6, "0"), count]);
}}"""
_UNTIL_CHANGED = f"""(before) => new Promise((resolve, reject) => {{ {_READ}
  const end = performance.now() + 60000;
  let last = before;
  const look = () => {{
    const now = digest(read());
    if (now !== before && now === last) resolve(true);
    else if (performance.now() > end) reject(new Error("the scene has not changed"));
    else {{ last = now; window.__viserMutable.requestRender(); setTimeout(look, 150); }}
  }};
  look();
}})"""


def hash_of(counts: Counter[tuple[int, int, int]]) -> int:
    total = 0
    for (red, green, blue), count in counts.items():
        total = (total + ((red << 16 | green << 8 | blue) % 99991) * count) % 2147483647
    return total


def open_page(served: Served, browser: Browser, width: int, height: int, *, has_scene: bool = True) -> Viewer:
    """Open the page; without its scene nothing has to be drawn, which takes most of the time."""
    page = browser.new_page(viewport={"width": width, "height": height})
    if not has_scene:
        page.route("**/viewer/", lambda route: route.fulfill(body=""))
    viewer = Viewer(served, page)

    def heard(message: ConsoleMessage) -> None:
        if message.type == "error":
            viewer.complaints.append(message.text)

    page.on("console", heard)
    page.on("request", lambda request: viewer.asked.append(request.url))
    page.on("websocket", lambda socket: viewer.asked.append(socket.url))
    page.on("pageerror", lambda error: viewer.complaints.append(str(error)))
    page.goto(served.url)
    # The names give way to a list where several pairs are open.
    expect(page.locator("#model")).not_to_be_empty(timeout=LONG_S * 1000)
    return viewer


def rgb(hexed: str) -> tuple[int, int, int]:
    return int(hexed[1:3], 16), int(hexed[3:5], 16), int(hexed[5:7], 16)


# Boxes that hold others, and what must not overlap.
LAYOUT = """() => {
  const box = (element) => element.getBoundingClientRect();
  const name = (element) => element.id || element.className || element.tagName;
  const visible = [...document.querySelectorAll("body *")]
    .filter((element) => element.checkVisibility() && !element.closest("svg"));
  const scrolls = (element) => /auto|scroll/.test(getComputedStyle(element).overflowY);
  const outside = visible.filter((element) => {
    for (let inner = element.parentElement; inner !== document.body; inner = inner.parentElement) {
      if (scrolls(inner) && inner.scrollHeight > inner.clientHeight + 1) return false;
    }
    const { x, y, right, bottom } = box(element);
    return x < -0.5 || y < -0.5 || right > innerWidth + 0.5 || bottom > innerHeight + 1.5;
  }).map(name);
  // Names of files may be long, and are cut with an ellipsis and a tooltip.
  const mayBeCut = ".pair-names, .model, select, .legend-title, h2 small";
  const cut = visible.filter((element) => element.scrollWidth > element.clientWidth + 1 && element.clientWidth > 0
    && getComputedStyle(element).display !== "inline" && !element.matches(mayBeCut) && !element.closest("select"))
    .map((element) => `${name(element)}: ${element.textContent.trim().slice(0, 40)}`);
  const higher = [...document.querySelectorAll(".controls, .panel, .dock, .tabpanel, .legend-strip")]
    .filter((element) => element.scrollHeight > element.clientHeight + 1);
  const hidden = higher.filter((element) => !scrolls(element)).map(name);
  const scrolled = higher.filter(scrolls).map(name);
  const overlapping = [];
  const groups = ["body > *", ".top > :not(.progress)", ".controls > *", ".row > *", ".dock > :not(.dock-edge)",
    ".tab-strip > *", ".tabs > *", ".tabpanel > *", ".legend-strip > *", ".actions > *", ".panel > *",
    "#funnel > li", "#figures > *", ".ramp-ticks > *", "#swatches > *", ".stage > :not(iframe)"];
  for (const group of groups) {
    const parents = new Map();
    for (const element of document.querySelectorAll(group)) {
      if (!element.checkVisibility()) continue;
      parents.set(element.parentElement, [...(parents.get(element.parentElement) ?? []), element]);
    }
    for (const siblings of parents.values()) for (const [index, one] of siblings.entries())
      for (const other of siblings.slice(index + 1)) {
        const [a, b] = [box(one), box(other)];
        if (a.x < b.right - 1 && b.x < a.right - 1 && a.y < b.bottom - 1 && b.y < a.bottom - 1)
          overlapping.push(`${name(one)} and ${name(other)}`);
      }
  }
  const texts = [...document.querySelectorAll("#curve text")].map((element) => [element.textContent, box(element)]);
  const panel = box(document.querySelector(".panel.curve"));
  const stray = texts.filter(([, text]) => text.x < panel.x || text.right > panel.right || text.bottom > panel.bottom)
    .map(([text]) => text);
  return { outside, cut, hidden, scrolled, overlapping, stray };
}"""
