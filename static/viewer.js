// Runs in the frame of the scene before viser's client, and hurries that along where no graphics card helps it. It leans
// on what viser 1.1.1 exposes for its tests; without that, the scene is only slower.

// Its sorter for Gaussian splats, which are never drawn here, needs `eval`; that our policy refuses it is no error.
addEventListener("unhandledrejection", (event) => {
  if (event.reason instanceof EvalError) event.preventDefault();
});

// Smoothed edges take half of the time of a frame where the processor draws.
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return getContext.call(this, kind, kind === "webgl2" && options?.antialias && !hasGraphicsCard() ? { ...options, antialias: false } : options);
};

function hasGraphicsCard() {
  const probe = new OffscreenCanvas(1, 1).getContext("webgl2");
  const names = probe?.getExtension("WEBGL_debug_renderer_info");
  const renderer = names ? probe.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  probe?.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|softpipe|basic render/i.test(renderer);
}

// Viser takes messages in at the start of a frame, which still shows the scene before them. Taken in as they arrive, they
// are shown by the next frame, not by the one after it. After every request it also goes on drawing for a quarter of a
// second, which without a graphics card takes processors from what is computed: there it draws once, and once more only
// after what React may have to add.
const AFTER_REACT_MS = 120;
const drawsOnce = !hasGraphicsCard();

// It draws every second besides, in case something has changed without a request. Where that takes processors, too, it does
// so after what React may have to add, and else once in ten seconds.
const BEAT_MS = 1000, RARELY = 10, HEEDED_MS = 3000;
const isBeat = (act, delay) => drawsOnce && delay === BEAT_MS && /^\(\) ?=> ?\w+\(\)$/.test(String(act));
let heededUntil = 0, beats = 0;
const repeat = window.setInterval;
window.setInterval = (act, delay, ...rest) => {
  const beat = () => (performance.now() < heededUntil || ++beats % RARELY === 0) && act();
  return repeat.call(window, isBeat(act, delay) ? beat : act, delay, ...rest);
};

let exposed;
Object.defineProperty(window, "__viserMutable", {
  configurable: true,
  get: () => exposed,
  set: (viewer) => {
    exposed = viewer;
    let request = viewer.requestRender;
    let last = null; // a timer
    const takeInAndRequest = () => {
      const isReady = viewer.getRenderRequestState === "ready";
      const needsReact = !viewer.messageQueue.every(({ type }) => type === "SceneNodeUpdateMessage");
      if (viewer.messageQueue.length && isReady) viewer.drainMessageQueue?.();
      if (needsReact) heededUntil = performance.now() + HEEDED_MS;
      const draw = isReady && drawsOnce ? viewer.scene?.__r3f?.root?.getState?.().invalidate : null;
      if (!draw) return request();
      draw();
      if (needsReact) {
        clearTimeout(last);
        last = setTimeout(draw, AFTER_REACT_MS);
      }
    };
    Object.defineProperty(viewer, "requestRender", {
      configurable: true, get: () => takeInAndRequest, set: (next) => { request = next; },
    });
  },
});
