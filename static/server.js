// Talking to the server: its state, changes to its settings, and requests beside these.

let latest = null;
let refusal = null; // why the last change was not made
let isOffline = false;
const listeners = [];

/** The last state that the server sent, or null. */
export const state = () => latest;

/** Why the last change was not made, or null; and a way to say so, or to forget it. */
export const refused = () => refusal;

export function refuse(message) {
  refusal = message;
  tell();
}

export const offline = () => isOffline;

/** Call `listener` after every change of the state, of its status alone where its argument says so. */
export const listen = (listener) => listeners.push(listener);

// Where no graphics card helps, painting the page and drawing the scene wait for each other and for what is computed: a
// change's colours go first, then what the page says of it, and what it would say only until then is left out.
const AFTER_COLORS_MS = 60;
const LONGEST_MS = 150;
const PREVIEWED_MS = 1000; // a preview says less than its colours do
let due = null; // a timer
let dueBy = null;

function tell({ onlyStatus = false } = {}) {
  if (!onlyStatus) {
    clearTimeout(due);
    dueBy = null;
  }
  for (const listener of listeners) listener({ onlyStatus });
}

function tellAfterColors() {
  const now = performance.now();
  const isPreview = latest.previewed !== null;
  dueBy = Math.min(dueBy ?? Infinity, now + (isPreview ? PREVIEWED_MS : LONGEST_MS));
  clearTimeout(due);
  due = setTimeout(tell, Math.min(isPreview ? PREVIEWED_MS : AFTER_COLORS_MS, dueBy - now));
}

// One request at a time: while one is under way, later changes gather and go together.
let waiting = null;
let underWay = null;

export function change(settings) {
  waiting = { ...waiting, ...settings };
  if (!underWay) send();
}

/** What was asked for and the server may not know yet. */
export const pending = (name) => ({ ...underWay, ...waiting })[name];

/** What was chosen, though the server may not know it yet: a control never jumps back meanwhile. */
export const chosen = () => ({ ...latest.settings, ...underWay, ...waiting });

async function send() {
  while (waiting) {
    underWay = waiting;
    waiting = null;
    try {
      const content = await api("settings", { method: "PATCH", body: underWay });
      underWay = null;
      refusal = null;
      show(content);
    } catch (error) {
      underWay = null;
      if (error instanceof Refusal) refuse(error.message);
      else lost();
    }
  }
}

/** An answer of the server that says why something cannot be done. */
export class Refusal extends Error {}

/**
 * Ask `path` under `api/` and give the answer's JSON, or null where it has none.
 *
 * `body` is sent as JSON, `content` as it is. Throws a `Refusal` with a line for the person, or what `fetch` throws where there is no answer.
 */
export async function api(path, { body, content: raw, ...rest } = {}) {
  const sent = body === undefined ? { body: raw } : { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  const answer = await fetch(`api/${path}`, { ...sent, ...rest });
  const isEmpty = answer.status === 204 || answer.headers.get("Content-Length") === "0";
  const content = !isEmpty && answer.headers.get("Content-Type")?.startsWith("application/json") ? await answer.json() : null;
  if (!answer.ok) throw new Refusal(content?.message ?? `The server answered ${answer.status}.`);
  return content;
}

/** Ask for something that answers with the new state, and show that. */
export async function act(path, body) {
  show(await api(path, { method: "POST", body }));
}

export function connect() {
  const events = new EventSource("api/events");
  events.addEventListener("state", (event) => {
    const next = JSON.parse(event.data);
    // The answer to our own change has shown this already.
    show(next, { onlyStatus: next.revision === latest?.revision && !isOffline });
  });
  events.addEventListener("status", (event) => {
    if (!latest) return;
    isOffline = false;
    latest.status = JSON.parse(event.data);
    tell({ onlyStatus: dueBy === null });
  });
  events.onerror = lost;
}

function lost() {
  isOffline = true;
  tell({ onlyStatus: true });
}

function show(next, { onlyStatus = false } = {}) {
  // Answers and events may overtake each other.
  if (latest && next.revision < latest.revision) return;
  const isFirst = latest === null || isOffline;
  isOffline = false;
  latest = next;
  if (onlyStatus || isFirst) tell({ onlyStatus });
  else tellAfterColors();
}
