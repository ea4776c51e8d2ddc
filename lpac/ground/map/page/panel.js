// The side: fleet list, alarms, events.

import { $, age, look, make, number, setClass, setText, sync } from "./dom.js";

const MAX_EVENTS = 200;

export function chip(robot) {
  return setChip(make("i", "chip"), robot);
}

export function setChip(element, robot) {
  const { style, letter } = look(robot);
  setClass(element, `chip ${style} ${robot.in_air ? "air" : "ground"}`);
  setText(element, letter);
  return element;
}

export function battery(share) {
  return share === null || share === undefined ? "" : share <= 0.15 ? "bad" : share <= 0.3 ? "low" : "";
}

// What a robot's row says beside its state: what is asked of it, or why it is as it is.
function remark(robot) {
  if (robot.duplicate) return "two programs are this robot";
  if (robot.state === "preflight" && !robot.ready) return robot.failed_checks[0] ?? "";
  if (robot.asked !== "none" && robot.in_air && robot.asked !== robot.state) return `${robot.asked} is asked`;
  // The state says as much.
  return robot.reason_code === "mission_started" ? "" : (robot.reason ?? "");
}

export function showFleet(robots, alarmed, selected, onPick) {
  sync(
    $("#robots tbody"), robots, (robot) => robot.name,
    (robot) => {
      const row = make("tr", "", make("td", "", make("i", "chip")));
      for (const name of ["name", "state", "n", "n", "n", "n"]) row.append(make("td", name));
      row.children[2].append(make("b"), " ", make("small"));
      row.dataset.robot = robot.name;
      row.tabIndex = 0;
      row.addEventListener("click", () => onPick(robot.name));
      row.addEventListener("keydown", (event) => {
        if (event.key === "Enter") onPick(robot.name);
      });
      return row;
    },
    (row, robot) => {
      const severity = alarmed.get(robot.name);
      setClass(row, [robot.name === selected && "chosen", !robot.fresh && "stale", severity].filter(Boolean).join(" "));
      const cells = row.children;
      setChip(cells[0].firstChild, robot);
      setText(cells[1], robot.name);
      const state = look(robot).name;
      row.dataset.state = robot.fresh ? robot.state : "lost";
      setText(cells[2].firstChild, state);
      setText(cells[2].lastChild, remark(robot));
      cells[2].title = [state, robot.reason].filter(Boolean).join(": ");
      setText(cells[3], robot.position_m == null ? "–" : `${number(robot.position_m[2], 1)} m`);
      setText(cells[4], robot.battery == null ? "–" : `${Math.round(robot.battery * 100)} %`);
      setClass(cells[4], `n ${battery(robot.battery)}`);
      setText(cells[5], number(robot.satellites));
      setText(cells[6], age(robot.age_s));
    },
  );
}

const SIGNS = { critical: "!", warning: "▲", note: "i" };

export function showAlarms(alarms, onPick) {
  const grave = alarms.filter(({ severity }) => severity !== "note").length;
  setText($("#alarm-count"), alarms.length ? `${alarms.length}` : "none");
  setClass($("#alarms"), grave ? "some" : "");
  sync(
    $("#alarms ul"), alarms, (alarm) => `${alarm.severity}|${alarm.robot}|${alarm.text}`,
    (alarm) => {
      const item = make(
        "li", alarm.severity, make("i", "", SIGNS[alarm.severity] ?? "!"), make("b", "", alarm.robot || "fleet"),
        make("span", "", alarm.text),
      );
      item.title = alarm.text;
      if (alarm.robot) {
        item.tabIndex = 0;
        item.addEventListener("click", () => onPick(alarm.robot));
      }
      return item;
    },
    () => {},
  );
}

export function addEvent(event) {
  const list = $("#events ol");
  const time = new Date(event.unix_time_s * 1000).toTimeString().slice(0, 8);
  const who = event.robot || event.operator;
  const item = make("li", event.what, make("time", "", time), make("b", "", who), make("span", "", event.text));
  item.title = [event.operator && `by ${event.operator}`, event.text].filter(Boolean).join(": ");
  list.prepend(item);
  while (list.children.length > MAX_EVENTS) list.lastElementChild.remove();
}
