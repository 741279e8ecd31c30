// The page: shows the state that the server sends, and sends back what a person chooses. It keeps no state of its own
// but what is only about this window, so every tab of the browser shows the same.

import { command, listenToKeys } from "./commands.js";
import { listenToControls, renderControls } from "./controls.js";
import { listenToLinks } from "./links.js";
import { listenToLoading } from "./load.js";
import { listenToDialogs } from "./dialogs.js";
import { renderLegend } from "./legend.js";
import { $ } from "./lib/dom.js";
import * as compare from "./panels/compare.js";
import * as diagnosis from "./panels/diagnosis.js";
import * as plots from "./panels/plots.js";
import * as point from "./panels/point.js";
import * as poses from "./panels/poses.js";
import * as share from "./panels/share.js";
import * as summary from "./panels/summary.js";
import * as server from "./server.js";
import { renderNotices, renderPair, renderStatus } from "./status.js";
import { makeTabs } from "./tabs.js";

const page = {
  state: server.state,
  chosen: server.chosen,
  change: server.change,
  api: server.api,
  act: server.act,
  refuse: server.refuse,
  command,
  /** Show the tab of that name. */
  open: (name) => tabs.open(name),
  /** Call `run` once everything shown belongs to the settings. */
  whenSettled: (run) => {
    if (server.state()?.settled) run();
    else waiting.push(run);
  },
};

const waiting = [];

const tabs = makeTabs([
  { name: "summary", title: "Summary", module: summary },
  { name: "diagnosis", title: "Diagnosis", module: diagnosis },
  { name: "point", title: "Point", module: point },
  { name: "plots", title: "Plots", module: plots },
  { name: "poses", title: "Poses", module: poses },
  { name: "compare", title: "Compare", module: compare },
  { name: "share", title: "Share", module: share },
], page);

function render({ onlyStatus }) {
  const state = server.state();
  if (state || server.offline()) renderStatus();
  if (onlyStatus) return;
  renderNotices();
  if (!state) return;
  renderPair();
  if (state.controls) {
    renderControls(state);
    renderLegend(state);
  }
  tabs.render();
  if (state.settled) for (const run of waiting.splice(0)) run();
}

listenToControls(page);
listenToDialogs(page);
listenToKeys($("scene"));
listenToLinks(page);
listenToLoading(page);
new ResizeObserver(() => server.state()?.legend && renderLegend(server.state())).observe($("legend"));
server.listen(render);
server.connect();
