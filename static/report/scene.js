// The scene of a report: points and matches in WebGL, turned by mouse, fingers or keys. No library.

const FIELD_OF_VIEW = (40 * Math.PI) / 180;
const MARGIN = 1.05;
const SAMPLE = 2000; // points that decide how near the camera comes

const POINT_SHADER = `#version 300 es
  uniform mat4 camera; uniform mat3 rotation; uniform vec3 position; uniform vec3 low; uniform vec3 span; uniform float size;
  in vec3 steps; in vec3 color; out vec3 shade;
  void main() {
    gl_Position = camera * vec4(rotation * (low + span * steps) + position, 1.0);
    gl_PointSize = clamp(size / gl_Position.w, 1.5, 64.0);
    shade = color;
  }`;
const DISC_SHADER = `#version 300 es
  precision mediump float;
  in vec3 shade; out vec4 pixel;
  void main() {
    if (length(gl_PointCoord - 0.5) > 0.5) discard;
    pixel = vec4(shade, 1.0);
  }`;
// A match is a strip of two triangles, as wide on the screen wherever it lies.
const LINE_SHADER = `#version 300 es
  uniform mat4 camera; uniform mat3 rotation; uniform vec3 position; uniform vec2 window; uniform float width;
  in vec2 corner; in vec3 start; in vec3 end; in vec3 color; out vec3 shade;
  void main() {
    vec4 a = camera * vec4(rotation * start + position, 1.0);
    vec4 b = camera * vec4(end, 1.0);
    vec2 along = (b.xy / b.w - a.xy / a.w) * window;
    vec2 aside = normalize(vec2(-along.y, along.x) + 1e-9) * width / window;
    vec4 at = mix(a, b, corner.x);
    gl_Position = at + vec4(aside * corner.y * at.w, 0.0, 0.0);
    shade = color;
  }`;
const FLAT_SHADER = `#version 300 es
  precision mediump float;
  in vec3 shade; out vec4 pixel;
  void main() { pixel = vec4(shade, 1.0); }`;

const add = (a, b) => a.map((value, axis) => value + b[axis]);
const subtract = (a, b) => a.map((value, axis) => value - b[axis]);
const times = (a, factor) => a.map((value) => value * factor);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => times(a, 1 / Math.hypot(...a));
/** A matrix, row by row, times a column. */
const turn = (rows, a) => [0, 3, 6].map((at) => dot(rows.slice(at, at + 3), a));

function bytes(text) {
  const decoded = atob(text);
  const array = new Uint8Array(decoded.length);
  for (let at = 0; at < decoded.length; at += 1) array[at] = decoded.charCodeAt(at);
  return array;
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const uniforms = {};
  for (let at = 0; at < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); at += 1) {
    const { name } = gl.getActiveUniform(made, at);
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms, attribute: (name) => gl.getAttribLocation(made, name) };
}

/** Fill a buffer, and have an attribute of the bound vertex array read from it. */
function feed(gl, location, array, { size = 3, type, normalized = false, stride = 0, offset = 0, divisor = 0, buffer = gl.createBuffer() }) {
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  if (array) gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(location);
  gl.vertexAttribPointer(location, size, type, normalized, stride, offset);
  gl.vertexAttribDivisor(location, divisor);
  return buffer;
}

/** Draw `scene` into `canvas`; null where there is no WebGL. */
export function makeScene(canvas, scene) {
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) return null;
  const points = program(gl, POINT_SHADER, DISC_SHADER);
  const strips = program(gl, LINE_SHADER, FLAT_SHADER);

  const clouds = ["source", "target"].map((side) => {
    const { count, low, high, steps } = scene[side];
    const values = new Uint16Array(bytes(steps).buffer);
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    feed(gl, points.attribute("steps"), values, { type: gl.UNSIGNED_SHORT, normalized: true });
    const span = subtract(high, low);
    const sample = [];
    for (let row = 0; row < count; row += Math.max(1, Math.floor(count / SAMPLE))) {
      sample.push(low.map((value, axis) => value + (span[axis] * values[3 * row + axis]) / 65535));
    }
    return { side, count, low, span, array, sample, colors: gl.createBuffer() };
  });

  const lines = { count: scene.lines.count, array: gl.createVertexArray() };
  gl.bindVertexArray(lines.array);
  feed(gl, strips.attribute("corner"), new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]), { size: 2, type: gl.FLOAT });
  const ends = feed(gl, strips.attribute("start"), bytes(scene.lines.ends), { type: gl.FLOAT, stride: 24, divisor: 1 });
  feed(gl, strips.attribute("end"), null, { type: gl.FLOAT, stride: 24, offset: 12, divisor: 1, buffer: ends });
  feed(gl, strips.attribute("color"), bytes(scene.lines.colors), { type: gl.UNSIGNED_BYTE, normalized: true, divisor: 1 });

  const up = scene.up;
  const front = unit(subtract(scene.direction, times(up, dot(scene.direction, up))));
  const view = { yaw: 0, pitch: 0, distance: 1, target: [0, 0, 0] };
  let place = null;
  let hasLines = true;
  let asked = false;

  const direction = () => add(
    times(add(times(front, Math.cos(view.yaw)), times(cross(up, front), Math.sin(view.yaw))), Math.cos(view.pitch)),
    times(up, Math.sin(view.pitch)));
  const axes = () => {
    const back = direction();
    const right = unit(cross(up, back));
    return [right, cross(back, right), back];
  };

  /** Have everything in the middle of the window, as large as it fits. */
  function home() {
    view.yaw = 0;
    view.pitch = Math.asin(dot(scene.direction, up));
    const frame = axes();
    const { rotation, position } = place;
    const seen = [...clouds[0].sample.map((point) => add(turn(rotation, point), position)), ...clouds[1].sample]
      .map((point) => frame.map((axis) => dot(axis, point)));
    const slope = Math.tan(FIELD_OF_VIEW / 2);
    const slopes = [slope * Math.max(canvas.clientWidth, 1) / Math.max(canvas.clientHeight, 1), slope];
    const range = (values) => [Math.min(...values), Math.max(...values)];
    const middle = [0, 1, 2].map((axis) => range(seen.map((point) => point[axis])).reduce((a, b) => (a + b) / 2));
    for (let step = 0; step < 6; step += 1) {
      const offsets = seen.map((point) => subtract(point, middle));
      view.distance = MARGIN * Math.max(...offsets.map((at) => Math.max(Math.abs(at[0]) / slopes[0], Math.abs(at[1]) / slopes[1]) + at[2]));
      // What is near looks larger, so the middle of the picture is not that of the points.
      for (const axis of [0, 1]) {
        const [low, high] = range(offsets.map((at) => at[axis] / (view.distance - at[2])));
        middle[axis] += ((low + high) / 2) * view.distance;
      }
    }
    view.target = [0, 1, 2].map((axis) => frame.reduce((sum, line, at) => sum + line[axis] * middle[at], 0));
    ask();
  }

  function draw() {
    asked = false;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((value) => Math.max(1, Math.round(value * ratio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const [right, over, back] = axes();
    const eye = add(view.target, times(back, view.distance));
    const near = view.distance / 100;
    const far = view.distance + 40;
    const tall = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const wide = (tall * height) / width;
    const [a, b] = [(far + near) / (near - far), (2 * far * near) / (near - far)];
    const depth = -dot(back, eye);
    // Projection times view, column by column.
    const camera = [0, 1, 2].flatMap((axis) => [wide * right[axis], tall * over[axis], a * back[axis], -back[axis]])
      .concat([-wide * dot(right, eye), -tall * dot(over, eye), a * depth + b, -depth]);
    const still = { rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], position: [0, 0, 0] };
    gl.useProgram(points.made);
    gl.uniformMatrix4fv(points.uniforms.camera, false, camera);
    gl.uniform1f(points.uniforms.size, scene.point_size * tall * height);
    for (const cloud of clouds) {
      const { rotation, position } = cloud.side === "source" ? place : still;
      gl.uniformMatrix3fv(points.uniforms.rotation, true, rotation);
      gl.uniform3fv(points.uniforms.position, position);
      gl.uniform3fv(points.uniforms.low, cloud.low);
      gl.uniform3fv(points.uniforms.span, cloud.span);
      gl.bindVertexArray(cloud.array);
      gl.drawArrays(gl.POINTS, 0, cloud.count);
    }
    if (!hasLines || !lines.count) return;
    gl.useProgram(strips.made);
    gl.uniformMatrix4fv(strips.uniforms.camera, false, camera);
    gl.uniformMatrix3fv(strips.uniforms.rotation, true, place.rotation);
    gl.uniform3fv(strips.uniforms.position, place.position);
    gl.uniform2f(strips.uniforms.window, width, height);
    gl.uniform1f(strips.uniforms.width, 1.6 * ratio);
    gl.bindVertexArray(lines.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, lines.count);
  }

  function ask() {
    if (!asked) requestAnimationFrame(draw);
    asked = true;
  }

  function orbit(across, down) {
    view.yaw -= across;
    view.pitch = Math.min(Math.max(view.pitch + down, -1.55), 1.55);
    ask();
  }

  function pan(across, down) {
    const [right, over] = axes();
    const pixel = (2 * view.distance * Math.tan(FIELD_OF_VIEW / 2)) / canvas.clientHeight;
    view.target = add(view.target, add(times(right, -across * pixel), times(over, down * pixel)));
    ask();
  }

  function zoom(factor) {
    view.distance = Math.min(Math.max(view.distance * factor, 0.02), 100);
    ask();
  }

  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const apart = () => { const [one, other] = [...held.values()]; return Math.hypot(one[0] - other[0], one[1] - other[1]); };
    const [across, down] = [event.clientX - before[0], event.clientY - before[1]];
    const distance = held.size === 2 ? apart() : 0;
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 2) {
      zoom(distance / Math.max(apart(), 1));
      pan(across / 2, down / 2);
    } else if (event.buttons & 6 || event.shiftKey) pan(across, down);
    else orbit(across * 0.007, down * 0.007);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.04 : 0.0012)));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const moves = {
      ArrowLeft: () => orbit(0.1, 0), ArrowRight: () => orbit(-0.1, 0), ArrowUp: () => orbit(0, 0.1), ArrowDown: () => orbit(0, -0.1),
      "+": () => zoom(0.9), "-": () => zoom(1.1), r: home,
    };
    if (!moves[event.key] || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    moves[event.key]();
  });
  new ResizeObserver(ask).observe(canvas);

  return {
    home,
    /** Colour the points by the name of a colouring. */
    color(name) {
      for (const { side, array, colors } of clouds) {
        gl.bindVertexArray(array);
        feed(gl, points.attribute("color"), bytes(scene.colors[name][side]), { type: gl.UNSIGNED_BYTE, normalized: true, buffer: colors });
      }
      ask();
    },
    /** Move the source to where a pose and a layout have it. */
    move(pose, layout) {
      place = scene.places[pose][layout];
      home();
    },
    lines(shown) {
      hasLines = shown;
      ask();
    },
  };
}
