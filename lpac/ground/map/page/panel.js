// Side panel: fleet list, alarms, events.

import { $, make, setClass, setText, sync } from "./dom.js";

const MAX_EVENTS = 200;
const COLUMNS = ["height", "battery", "satellites", "link"];

export function chip() {
  return make("i", "chip");
}

export function setChip(element, robot) {
  setClass(element, `chip ${robot.look} ${robot.in_air ? "air" : "ground"}`);
  setText(element, robot.letter);
  element.style.background = `var(--${robot.look})`;
}

export function showFleet(robots, selected, onPick) {
  sync(
    $("#robots tbody"), robots, (robot) => robot.name,
    (robot) => {
      const row = make("tr", "", make("td", "", chip()));
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
      setClass(row, [robot.name === selected && "chosen", !robot.fresh && "stale", robot.severity].filter(Boolean).join(" "));
      const cells = row.children;
      setChip(cells[0].firstChild, robot);
      setText(cells[1], robot.name);
      row.dataset.state = robot.fresh ? robot.state : "lost";
      setText(cells[2].firstChild, robot.word);
      setText(cells[2].lastChild, robot.problem);
      cells[2].title = [robot.word, robot.problem].filter(Boolean).join(": ");
      COLUMNS.forEach((column, n) => {
        const [text, style] = robot.cells[column];
        setText(cells[3 + n], text);
        setClass(cells[3 + n], `n ${style}`);
      });
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
