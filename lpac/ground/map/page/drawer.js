// Details of one robot, as texts from the server.

import { make, setClass, setText, sync } from "./dom.js";
import { chip, setChip } from "./panel.js";

export class Drawer {
  constructor(element, { onClose, onAct }) {
    this.element = element;
    this.robot = null;
    this.chip = chip();
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
    this.facts = make("dl");
    this.tables = make("div", "tables");
    this.kill = make("p", "kill");
    this.body = make("div", "scroll", this.facts, this.tables, this.kill);
    element.append(head, this.state, this.acts, this.body);
  }

  open(name, operate) {
    // Clear, so that one robot's values never appear below another's name.
    if (name !== this.robot) this.body.hidden = true;
    this.robot = name;
    this.element.hidden = name === null;
    if (name === null) return;
    setText(this.name, name);
    this.acts.hidden = !operate;
    for (const button of this.acts.children) setText(button, `${button.label} ${name}`);
    setText(
      this.kill,
      `No kill here: \`lpac mission kill --robots ${name}\` stops its motors, and it falls.`,
    );
  }

  // From the snapshot, at 5 Hz.
  showSnapshot(robot) {
    setChip(this.chip, robot);
    setText(this.state, [robot.word, robot.problem].filter(Boolean).join(": "));
  }

  // From the robot's complete status.
  show({ name, facts, tables }) {
    if (name !== this.robot) return;
    this.body.hidden = false;
    const seen = new Map();
    const keyed = facts.map(([label, text, style]) => {
      seen.set(label, (seen.get(label) ?? 0) + 1);
      return { key: `${label} ${seen.get(label)}`, label, text, style };
    });
    sync(
      this.facts, keyed, ({ key }) => key,
      () => make("div", "", make("dt"), make("dd")),
      (row, { label, text, style }) => {
        setText(row.firstChild, label);
        setText(row.lastChild, text);
        setClass(row.lastChild, style);
      },
    );
    sync(
      this.tables, tables, ({ headings }) => headings[0],
      ({ headings }) => {
        const head = make("tr", "", ...headings.map((text, n) => make("th", n ? "n" : "", text)));
        return make("table", "", make("thead", "", head), make("tbody"));
      },
      (table, { headings, rows }) => sync(
        table.lastChild, rows, ([[first]]) => first,
        () => make("tr", "", ...headings.map((_, n) => make("td", n ? "n" : ""))),
        (row, [cells, style]) => {
          headings.forEach((_, n) => setText(row.children[n], cells[n] ?? ""));
          setClass(row, style);
        },
      ),
    );
  }
}
