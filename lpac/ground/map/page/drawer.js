// Everything about one robot.

import { age, clock, direction, look, make, number, setClass, setText, sync } from "./dom.js";
import { battery, chip, setChip } from "./panel.js";

// Where checks count: in the air a robot is not ready to take off, and need not be.
const ON_GROUND = ["init", "idle", "preflight", "landed"];
const GROUPS = ["Vehicle", "Flight", "Checks and alarms", "Policy", "Program"];

export class Drawer {
  constructor(element, { onClose, onAct }) {
    this.element = element;
    this.robot = null;
    this.chip = chip({});
    this.name = make("h2");
    this.state = make("p", "state");
    const close = make("button", "plain", "×");
    close.title = "close (Esc)";
    close.setAttribute("aria-label", "close");
    close.addEventListener("click", onClose);
    const head = make("div", "head", this.chip, this.name, close);
    this.acts = make("div", "group");
    for (const [action, text] of [["hold", "Hold"], ["land", "Land"]]) {
      const button = make("button");
      button.dataset.robotDo = action;
      button.addEventListener("click", () => onAct(action, this.robot));
      button.label = text;
      this.acts.append(button);
    }
    this.groups = new Map(GROUPS.map((title) => [title, make("dl")]));
    this.neighbours = table(["neighbour", "rate", "age", "messages"]);
    this.loops = table(["loop", "late p50", "p99", "max", "missed", "failed"]);
    this.kill = make("p", "kill");
    this.body = make("div", "scroll");
    const section = (title, content) => this.body.append(make("h3", "", title), content);
    section("Vehicle", this.groups.get("Vehicle"));
    section("Flight", this.groups.get("Flight"));
    section("Checks and alarms", this.groups.get("Checks and alarms"));
    section("Neighbours", this.neighbours);
    section("Policy", this.groups.get("Policy"));
    section("Loops, ms", this.loops);
    section("Program", this.groups.get("Program"));
    this.body.append(this.kill);
    element.append(head, this.state, this.acts, this.body);
  }

  open(name, operate) {
    // Never one robot's numbers below another's name.
    if (name !== this.robot) this.body.hidden = true;
    this.robot = name;
    this.element.hidden = name === null;
    if (name === null) return;
    setText(this.name, name);
    this.acts.hidden = !operate;
    for (const button of this.acts.children) setText(button, `${button.label} ${name}`);
    setText(
      this.kill,
      `Kill is not here: \`lpac mission kill --robots ${name}\` stops its motors, and it falls.`,
    );
  }

  // From the snapshot: at 5 Hz, as the list.
  showSnapshot(robot) {
    setChip(this.chip, robot);
    setText(this.state, [look(robot).name, robot.reason].filter(Boolean).join(": "));
  }

  // From the robot's whole status.
  show({ name, status: s, age_s, clock_offset_s, rates_hz }, alarms) {
    if (name !== this.robot || !s) return;
    this.body.hidden = false;
    const [p, v] = [s.position_m, s.velocity_m_s];
    const speed = v && Math.hypot(v[0], v[1]);
    this.fill("Vehicle", [
      ["mode", s.mode ?? "–"],
      ["armed", yes(s.armed) + (s.in_air ? ", in the air" : "")],
      ["battery", s.battery === null ? "–" : `${(s.battery * 100).toFixed(0)} %${lasts(s)}`, battery(s.battery)],
      ["GPS", `${number(s.satellites)} satellites, hdop ${number(s.hdop, 1)}, ±${number(s.gps_accuracy_m, 1)} m`],
      ["position is", s.position_quality ?? "–", ["good", null].includes(s.position_quality) ? "" : "bad"],
      ["position", p ? `x ${number(p[0], 2)}  y ${number(p[1], 2)}  z ${number(p[2], 2)} m` : "–"],
      ["speed", v ? `${number(speed, 2)} m/s, climb ${number(v[2], 2)} m/s` : "–"],
      ["heading", s.heading_rad === null ? "–" : `${direction((s.heading_rad * 180) / Math.PI)} true`],
      ["lat, lon", s.global_deg ? s.global_deg.map((d) => number(d, 7)).join(", ") : "–"],
    ]);
    this.fill("Flight", [
      ["height", number(s.slot_height_m, 1, " m")],
      ["landing point", s.landing_point_m.map((m) => number(m, 1)).join(", ") + " m"],
      ["fence", s.fence ? `${s.fence.vertices_m.length} corners, ${s.fence.floor_m} to ${s.fence.ceiling_m} m` : "–"],
      ["trial", s.trial || "–"],
      ["obeys", `${s.operator || "nobody"}, state ${s.obeyed_sequence}`],
    ]);
    const own = alarms.filter(({ robot }) => robot === name);
    this.fill("Checks and alarms", [
      ...(ON_GROUND.includes(s.state) ? [
        ["ready", s.ready ? "yes" : "no"],
        ...s.failed_checks.map(({ text }) => ["fails", text, "bad", `fails ${text}`]),
      ] : []),
      ...(own.length ? [] : [["alarms", "none"]]),
      ...own.map((a) => ["alarm", a.text, a.severity === "note" ? "" : "bad", `alarm ${a.text}`]),
      ...s.not_taken.map((text) => ["not taken", text, "low", `taken ${text}`]),
    ]);
    const all = new Set([...Object.keys(s.neighbour_ages_s), ...Object.keys(rates_hz), ...Object.keys(s.neighbour_messages)]);
    rows(this.neighbours, [...all].sort(byName).map((other) => [
      other, number(rates_hz[other], 1, " Hz"),
      other in s.neighbour_ages_s ? age(s.neighbour_ages_s[other]) : "silent",
      number(s.neighbour_messages[other]),
    ]), (row) => (row[2] === "silent" ? "bad" : ""));
    const w = s.policy_velocity_m_s;
    this.fill("Policy", [
      ["wants", w ? `${number(w[0], 2)}, ${number(w[1], 2)} m/s` : "–"],
      ["features", s.feature_age_s === null ? "–" : `${age(s.feature_age_s)} old`],
      ["bundle", s.bundle_id.slice(0, 12)],
      ["world", s.world_id || "–"],
      ["messages", Object.entries(s.message_counts).map(([what, n]) => `${n} ${what}`).join(", ")],
    ]);
    rows(this.loops, Object.entries(s.loops).map(([loop, l]) => [
      loop, number(l.lateness_p50_ms, 1), number(l.lateness_p99_ms, 1), number(l.lateness_max_ms, 1),
      `${l.overruns}`, `${l.failures}`,
    ]), (row) => (row[5] !== "0" ? "bad" : ""));
    this.fill("Program", [
      ["runs for", clock(s.uptime_s)],
      ["heard", `${age(age_s)} ago, status ${s.sequence}`],
      ["clock", clock_offset_s === null ? "–" : `${clock_offset_s >= 0 ? "+" : "−"}${Math.abs(clock_offset_s * 1000).toFixed(0)} ms`],
      ["ids", `${s.robot_id}, system ${s.system_id ?? "–"}, start ${s.boot_nonce}`],
    ]);
  }

  fill(group, fields) {
    sync(
      this.groups.get(group), fields, ([label, , , key]) => key ?? label,
      () => make("div", "", make("dt"), make("dd")),
      (row, [label, text, style = ""]) => {
        setText(row.firstChild, label);
        setText(row.lastChild, text);
        setClass(row.lastChild, style);
      },
    );
  }
}

const lasts = (s) => (s.battery_lasts_s == null ? "" : `, ${s.battery_lasts_s.toFixed(0)} s`);
const yes = (value) => (value === null ? "–" : value ? "yes" : "no");
const byName = (a, b) => a.localeCompare(b, undefined, { numeric: true });

function table(headings) {
  const head = make("tr");
  headings.forEach((text, n) => head.append(make("th", n ? "n" : "", text)));
  return make("table", "", make("thead", "", head), make("tbody"));
}

function rows(element, items, style) {
  sync(
    element.lastChild, items, (item) => item[0],
    (item) => make("tr", "", ...item.map((_, n) => make("td", n ? "n" : ""))),
    (row, item) => {
      item.forEach((text, n) => setText(row.children[n], text));
      setClass(row, style(item));
    },
  );
}
