// The page: messages from the server, and the operator's commands.

import { $, clock, make, number, setClass, setText } from "./dom.js";
import { LAYERS, MapCanvas } from "./canvas.js";
import { Chart } from "./chart.js";
import { Drawer } from "./drawer.js";
import { addEvent, showAlarms, showFleet } from "./panel.js";

const RETRY_MS = 1000;
const QUIET_MS = 2000;

let socket = null;
let fleet = "";
let operate = false;
let setup = null;
let snapshot = null;
let snapshotAt = 0;
let problem = "connecting";
let curve = null;
let cost = null;
let missionTime = null;
let selected = null;

const map = new MapCanvas($("#map"), (name) => pick(name), showPointer);
const chart = new Chart($("#chart"));
const drawer = new Drawer($("#drawer"), {
  onClose: () => pick(null),
  onAct: (action, robot) => (action === "land" ? ask(action, [robot]) : act(action, [robot])),
});

const take = {
  hello(message) {
    operate = message.operate;
    fleet = message.fleet;
    document.title = `${fleet} · lpac map`;
    setText($("#fleet"), fleet);
    $("#bar").hidden = !operate;
    $("#observing").hidden = operate;
    $("#events ol").replaceChildren();
    if (selected) tell({ select: selected });
  },
  ground(message) {
    problem = message.problem;
    showLink();
  },
  setup(message) {
    setup = message;
    map.setSetup(message);
    $("#ramp").hidden = !map.known;
    setText($("#importance"), map.known ? "importance" : "no importance known");
    showCost();
  },
  paths(message) {
    map.paths = new Map(Object.entries(message.paths));
  },
  explored(message) {
    map.setExplored(message.robot, message.cells);
  },
  event: addEvent,
  curve(message) {
    if (curve && curve.began_s !== message.began_s) map.paths.clear();
    curve = message;
    showCost();
  },
  coverage(message) {
    map.cells = message.cells;
    map.draw();
    missionTime = message.time_s;
    cost = message.cost;
    if (curve && message.share !== null && message.share !== undefined) {
      if (curve.points.length >= 3000) curve.points = curve.points.filter((_, n) => n % 2 === 0);
      curve.points.push([message.time_s, message.share]);
    }
    showCost();
  },
  snapshot(message) {
    snapshot = message;
    snapshotAt = performance.now();
    map.setSnapshot(message);
    showHead();
    showAsked();
    showAlarms(message.alarms, pick);
    showFleet(message.robots, selected, pick);
    const robot = message.robots.find(({ name }) => name === selected);
    if (robot) drawer.showSnapshot(robot);
    showLink();
  },
  detail(message) {
    drawer.show(message);
  },
  report: showReport,
};

function connect() {
  const address = new URL("live", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(address);
  socket.addEventListener("message", ({ data }) => {
    const message = JSON.parse(data);
    take[message.kind]?.(message);
  });
  socket.addEventListener("close", () => {
    problem = "the map's own server is gone: start `lpac map` again";
    socket = null;
    showLink();
    setTimeout(connect, RETRY_MS);
  });
}

function tell(message) {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(message));
  return true;
}

const TITLES = {
  enable: "Enable", takeoff: "Take off", start: "Start", hold: "Hold", resume: "Resume",
  return: "Return", land: "Land", command: "Take command",
};

function act(action, robots = []) {
  if (!operate) return;
  if (tell({ do: action, robots })) return;
  toast(TITLES[action], "not sent", ["the map's own server is gone; `lpac mission " + action + "` in a terminal"], false);
}

// The same key in every view. A map that cannot command tells what can.
function hold() {
  if (operate) act("hold");
  else toast("Hold", "not from this map, which only observes", ["`lpac mission hold` in a terminal, or h in `lpac watch`"], false);
}

// Confirmation. It covers the map but not the bar, so that hold stays within reach.

let asked = null;

function ask(action, robots = []) {
  asked = { action, robots };
  showAsked();
  setText($("#ask-yes"), TITLES[action]);
  $("#ask").hidden = false;
  $("#ask-no").focus();
}

// Updated with every snapshot, so that "yes" confirms what is shown.
function showAsked() {
  if (!asked) return;
  const { title, lines } = question(asked);
  setText($("#ask-title"), title);
  const shown = [...$("#ask-text").children].map(({ textContent }) => textContent);
  if (lines.join("\n") === shown.join("\n")) return;
  $("#ask-text").replaceChildren(...lines.map((line) => make("p", "", line)));
}

function question({ action, robots }) {
  const all = snapshot?.robots ?? [];
  const names = new Set(robots.length ? robots : (setup?.slots ?? []).map(({ robot }) => robot));
  const addressed = all.filter(({ name }) => names.has(name));
  const list = (some) => some.map(({ name }) => name).join(", ");
  if (action === "takeoff") {
    const ready = addressed.filter((robot) => !robot.not_ready);
    const others = addressed.filter((robot) => robot.not_ready);
    return {
      title: `Take off ${ready.length} of ${addressed.length} robots?`,
      lines: [
        ready.length ? `Ready: ${list(ready)}.` : "None is ready.",
        ...[...groups(others, (robot) => robot.not_ready)].map(([reason, some]) => `Not ready: ${list(some)}: ${reason}`),
        "Motors start, one robot after another.",
      ],
    };
  }
  if (action === "command") {
    return {
      title: `Take the command from ${snapshot?.commander}?`,
      lines: ["Their running commands end, except a kill. From then on they can only observe and command hold."],
    };
  }
  const flying = addressed.filter(({ in_air: is }) => is);
  const what = robots.length ? robots.join(", ") : `all ${flying.length} robots in the air`;
  return {
    title: `Land ${what}, where ${flying.length === 1 ? "it is" : "they are"}?`,
    lines: ["Straight down, not at the landing points: that is Return."],
  };
}

function groups(items, keyOf) {
  const found = new Map();
  for (const item of items) found.set(keyOf(item), [...(found.get(keyOf(item)) ?? []), item]);
  return found;
}

function answer(yes) {
  $("#ask").hidden = true;
  if (yes && asked) act(asked.action, asked.robots);
  asked = null;
}

function showReport({ action, done, results, problem: why }) {
  const refused = groups(results.filter((r) => !r.done), ({ text }) => text);
  const lines = why ? [why.text] : [];
  const did = results.filter((r) => r.done).map((r) => r.robot);
  if (did.length && !done) lines.push(`${did.join(", ")}: done`);
  for (const [text, some] of refused) lines.push(`${some.map((r) => r.robot).join(", ")}: ${text}`);
  const outcome = why ? "refused" : results.length ? `${did.length} of ${results.length} done` : "done";
  toast(TITLES[action] ?? action, outcome, lines, done);
}

// The newest result of each action, until it is dismissed.
function toast(title, outcome, lines, good) {
  const element = make("div", good ? "toast good" : "toast bad", make("b", "", `${title}: ${outcome}`));
  element.dataset.action = title;
  for (const old of $("#toasts").children) if (old.dataset.action === title) old.remove();
  for (const line of lines) element.append(make("span", "", line));
  element.addEventListener("click", () => element.remove());
  $("#toasts").append(element);
  setTimeout(() => element.remove(), good ? 5000 : 20000);
}

function showHead() {
  const { robots, alarms, commander, own, safety_action: action, safety_action_by: by, trial, running } = snapshot;
  const sitting = new Set((setup?.slots ?? []).map(({ robot }) => robot));
  const ours = robots.filter(({ name }) => sitting.has(name));
  const enabled = ours.filter((robot) => robot.enabled).length;
  setText($("#commander"), commander || "nobody yet");
  const observes = commander && !own;
  setClass($("#commander"), observes ? "other" : "");
  $("#commander").title = observes ? `${commander} commands, not this station` : commander;
  $("#command").hidden = !observes;
  setText($("#trial"), trial || "–");
  const { origin } = snapshot;
  $("#no-origin").hidden = origin !== null;
  $("#origin").parentElement.hidden = origin === null;
  if (origin) setText($("#origin"), origin.map((degrees) => degrees.toFixed(5)).join(" "));
  setText($("#enabled"), ours.length ? `${enabled} of ${ours.length}` : "–");
  setText($("#flying"), `${robots.filter((r) => r.in_air).length}`);
  $("#safety-action").hidden = action === "none";
  setClass($("#safety-action"), `pill calm ${action}`);
  setText($("#safety-action"), `${action.toUpperCase()} by ${by}`);
  const flown = missionTime ?? (curve?.trial === trial ? curve.points.at(-1)?.[0] : null);
  setText($("#time"), flown == null ? "–" : clock(flown));
  const critical = alarms.filter(({ severity }) => severity === "critical").length;
  document.title = `${critical ? `(${critical}) ` : ""}${fleet} · lpac map`;
  setText($("#running"), running.length ? `now: ${running.join("; ")}` : "");
  showNext(ours, enabled, action);
}

// The usual next step is highlighted; every button works at any time.
function showNext(ours, enabled, action) {
  const fresh = ours.filter((robot) => robot.fresh);
  const every = (wanted) => fresh.length > 0 && fresh.every(({ look }) => look === wanted);
  let next = null;
  if (action === "hold" && fresh.some((robot) => robot.in_air)) next = "resume";
  else if (enabled < ours.length) next = "enable";
  else if (every("ready")) next = "takeoff";
  else if (action === "none" && every("hold")) next = "start";
  for (const button of document.querySelectorAll("#bar .group button")) {
    button.classList.toggle("next", button.dataset.do === next);
  }
}

function showCost() {
  // Without a known world there is no cost.
  const shown = map.known ? curve : null;
  chart.set(shown?.points ?? [], shown?.lloyd ?? null);
  setText($("#share"), number(shown?.points.at(-1)?.[1], 3));
  setText($("#lloyd"), shown ? (shown.lloyd === null ? "…" : number(shown.lloyd, 3)) : "–");
  setText($("#absolute"), map.known && cost !== null ? cost.toExponential(2).replace("+", "") : "–");
  $("#cost").title = shown && !shown.whole ? "The map was opened during the mission: J₀ is the first value since then." : "";
  $("#cost").classList.toggle("late", Boolean(shown && !shown.whole));
}

function showLink() {
  const quiet = snapshot && performance.now() - snapshotAt > QUIET_MS;
  const gone = problem || (quiet ? "the ground process sends nothing" : "");
  setClass($("#link"), `pill link ${gone ? "gone" : "live"}`);
  setText($("#link"), gone ? (socket ? "no ground" : "no map server") : "ground live");
  $("#banner").hidden = !gone;
  const below = snapshot ? "The map shows the last known state." : "There is nothing to show until then.";
  setText($("#banner"), gone && `${gone}. ${below}`);
  document.body.classList.toggle("gone", Boolean(gone));
}

function showPointer(at) {
  setText($("#pointer"), at ? `x ${at[0].toFixed(1)}  y ${at[1].toFixed(1)} m` : "");
}

function pick(name) {
  selected = name;
  tell({ select: name });
  map.select(name);
  drawer.open(name, operate);
  $("#side").classList.toggle("one", name !== null);
  const robot = snapshot?.robots.find((r) => r.name === name);
  if (robot) drawer.showSnapshot(robot);
  if (snapshot) showFleet(snapshot.robots, selected, pick);
}

// Theme and layers are kept in the browser's local storage.

function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function showTheme() {
  map.setTheme(isDark());
  map.paintRamp($("#ramp"));
  chart.paint();
}

function toggleTheme() {
  const theme = isDark() ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  localStorage.setItem("theme", theme);
  showTheme();
}

const kept = localStorage.getItem("theme");
if (kept === "light" || kept === "dark") document.documentElement.dataset.theme = kept;
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", showTheme);

const hidden = new Set((localStorage.getItem("hidden") ?? "").split(",").filter(Boolean));
for (const [name, title] of Object.entries(LAYERS)) {
  const box = make("input");
  box.type = "checkbox";
  box.checked = map.layers[name] = !hidden.has(name);
  box.addEventListener("change", () => {
    map.layers[name] = box.checked;
    hidden[box.checked ? "delete" : "add"](name);
    localStorage.setItem("hidden", [...hidden].join(","));
    map.draw();
  });
  $("#switches").append(make("label", "", box, title));
}

for (const button of document.querySelectorAll("[data-do]")) {
  button.addEventListener("click", () => {
    if ("ask" in button.dataset) ask(button.dataset.do);
    else act(button.dataset.do);
  });
}
$("#ask-no").addEventListener("click", () => answer(false));
$("#ask-yes").addEventListener("click", () => answer(true));
$("#theme").addEventListener("click", toggleTheme);
$("#in").addEventListener("click", () => map.zoom(1.4));
$("#out").addEventListener("click", () => map.zoom(1 / 1.4));
$("#fit").addEventListener("click", () => map.fit());

const KEYS = {
  h: hold,
  f: () => map.fit(),
  t: toggleTheme,
  "+": () => map.zoom(1.4),
  "-": () => map.zoom(1 / 1.4),
  Escape: () => (asked ? answer(false) : pick(null)),
};

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key]?.();
});

showTheme();
showLink();
setInterval(showLink, 500);
connect();
