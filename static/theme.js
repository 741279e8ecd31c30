// Light or dark, as the system has it or as was chosen here; runs before the first paint, so that nothing flashes.

(() => {
  const KEY = "cgf-viewer.theme";
  const ofTheSystem = () => (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");

  function apply() {
    for (const root of [document.documentElement, document.getElementById("scene")?.contentDocument?.documentElement]) {
      if (root) root.dataset.theme = localStorage.getItem(KEY) ?? "";
    }
  }

  /** Change between the two; what the system has is not kept, so that the page follows it again. */
  window.switchTheme = () => {
    const next = (localStorage.getItem(KEY) ?? ofTheSystem()) === "dark" ? "light" : "dark";
    if (next === ofTheSystem()) localStorage.removeItem(KEY);
    else localStorage.setItem(KEY, next);
    apply();
  };

  apply();
  addEventListener("storage", ({ key }) => key === KEY && apply());
  addEventListener("DOMContentLoaded", () => {
    apply();
    document.getElementById("scene")?.addEventListener("load", apply);
  });
})();
