// The map: the mission frame in metres, x to the right and y up.

import { circle, colour, direction, trace } from "./dom.js";

const EXPLORED_CELLS = 64;
// Robots send every 0.4 s, and drop messages older than 0.8 s.
const AGES_S = [0.5, 0.8];
const LONGEST_PATH = 400;
const PATH_STEP_M = 0.15;
const ARROW_S = 1.5; // a velocity arrow reaches where it would lead in this time

const COLOURS = [
  "paper", "field", "ink", "faint", "halo", "edge", "fence", "accent", "grid", "critical", "path",
  "age-0", "age-1", "age-2",
  "init", "idle", "preflight", "ready", "arming", "takeoff", "hold", "mission", "return", "land",
  "landed", "pilot", "fault", "lost",
];
const DARK_ON = new Set(["init", "idle", "preflight", "landed", "hold", "lost", "arming"]);

export const LAYERS = {
  density: "Density", explored: "Explored", cells: "Voronoi cells", links: "Links",
  paths: "Paths", velocity: "Wanted velocity", places: "Pads and landing points", names: "Names",
};

// Perceptually uniform: linear in OKLab from `low` to `high`, each [lightness, chroma, hue deg].
function ramp(low, high) {
  const lab = ([l, c, h]) => [l, c * Math.cos((h * Math.PI) / 180), c * Math.sin((h * Math.PI) / 180)];
  const [a, b] = [lab(low), lab(high)];
  const table = new Uint8ClampedArray(256 * 3);
  for (let n = 0; n < 256; n++) {
    const [L, A, B] = a.map((v, k) => v + ((b[k] - v) * n) / 255);
    const l = (L + 0.3963377774 * A + 0.2158037573 * B) ** 3;
    const m = (L - 0.1055613458 * A - 0.0638541728 * B) ** 3;
    const s = (L - 0.0894841775 * A - 1.291485548 * B) ** 3;
    const linear = [
      4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
      -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
      -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
    ];
    linear.forEach((v, k) => {
      table[n * 3 + k] = 255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);
    });
  }
  return table;
}

const RAMPS = {
  light: ramp([0.985, 0.006, 250], [0.5, 0.115, 265]),
  dark: ramp([0.225, 0.02, 265], [0.8, 0.1, 215]),
};

function bytes(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

export class MapCanvas {
  constructor(canvas, onPick, onPointer) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.layers = Object.fromEntries(Object.keys(LAYERS).map((name) => [name, true]));
    this.setup = null;
    this.known = false;
    this.snapshot = null;
    this.cells = {};
    this.paths = new Map();
    this.explored = new Map(); // name -> Uint8Array of 0 and 1, indexed [x, y]
    this.selected = null;
    this.view = null; // px per m, and the middle in m
    this.fitted = true;
    this.pending = false;
    this.onPick = onPick;
    this.onPointer = onPointer;
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.listen();
    this.setTheme(false);
  }

  setTheme(dark) {
    this.ink = Object.fromEntries(COLOURS.map((name) => [name, colour(name)]));
    this.table = dark ? RAMPS.dark : RAMPS.light;
    this.paintDensity();
    this.paintVeil();
    this.draw();
  }

  setSetup(setup) {
    this.setup = setup;
    this.levels = bytes(setup.density?.levels ?? "");
    // The ground may lack the world.
    this.known = this.levels.some((level) => level > 0);
    this.paintDensity();
    this.paintVeil();
    if (this.fitted) this.fit();
    this.draw();
  }

  setExplored(robot, cells) {
    const packed = bytes(cells);
    const seen = new Uint8Array(EXPLORED_CELLS ** 2);
    for (let n = 0; n < seen.length; n++) seen[n] = (packed[n >> 3] >> (7 - (n & 7))) & 1;
    this.explored.set(robot, seen);
    this.veilIsOld = true;
    this.draw();
  }

  setSnapshot(snapshot) {
    const reach = JSON.stringify(snapshot.fence);
    this.snapshot = snapshot;
    for (const robot of snapshot.robots) {
      if (!robot.in_air || !robot.fresh || !robot.position_m) continue;
      const path = this.paths.get(robot.name) ?? [];
      const [x, y] = robot.position_m;
      const last = path.at(-1);
      if (!last || Math.hypot(x - last[0], y - last[1]) >= PATH_STEP_M) path.push([x, y]);
      if (path.length > LONGEST_PATH) path.shift();
      this.paths.set(robot.name, path);
    }
    if (this.fitted && reach !== this.reach) this.fit();
    this.reach = reach;
    this.draw();
  }

  select(name) {
    this.selected = name;
    this.veilIsOld = true;
    this.draw();
  }

  resize() {
    const { clientWidth, clientHeight } = this.canvas;
    this.ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(clientWidth * this.ratio);
    this.canvas.height = Math.round(clientHeight * this.ratio);
    if (this.fitted) this.fit();
    this.draw();
  }

  fit() {
    if (!this.setup) return;
    const side = this.setup.side_m;
    const corners = [[0, 0], [side, side], ...(this.snapshot?.fence ?? [])];
    for (const slot of this.setup.slots) corners.push(slot.pad, slot.landing);
    const xs = corners.map(([x]) => x);
    const ys = corners.map(([, y]) => y);
    const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const { clientWidth: w, clientHeight: h } = this.canvas;
    // Room for the layers above and for the legend below.
    const scale = Math.min((w - 60) / (x1 - x0), (h - 92) / (y1 - y0));
    this.view = { scale: Math.max(scale, 0.5), x: (x0 + x1) / 2, y: (y0 + y1) / 2 - 4 / scale };
    this.fitted = true;
    this.draw();
  }

  zoom(factor, at = null) {
    if (!this.view) return;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const [px, py] = at ?? [w / 2, h / 2];
    const before = this.toMission(px, py);
    this.view.scale = Math.min(400, Math.max(0.5, this.view.scale * factor));
    const after = this.toMission(px, py);
    this.view.x += before[0] - after[0];
    this.view.y += before[1] - after[1];
    this.fitted = false;
    this.draw();
  }

  toScreen([x, y]) {
    const { scale, x: cx, y: cy } = this.view;
    return [
      this.canvas.clientWidth / 2 + (x - cx) * scale,
      this.canvas.clientHeight / 2 - (y - cy) * scale,
    ];
  }

  toMission(px, py) {
    const { scale, x, y } = this.view;
    return [
      x + (px - this.canvas.clientWidth / 2) / scale,
      y - (py - this.canvas.clientHeight / 2) / scale,
    ];
  }

  listen() {
    const { canvas } = this;
    let from = null;
    let moved = false;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), [event.offsetX, event.offsetY]);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      from = [event.offsetX, event.offsetY];
      moved = false;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.view) return;
      const here = [event.offsetX, event.offsetY];
      this.onPointer(this.toMission(...here));
      if (!from) {
        canvas.classList.toggle("over", this.robotAt(here) !== null);
        return;
      }
      const [dx, dy] = [here[0] - from[0], here[1] - from[1]];
      if (!moved && Math.hypot(dx, dy) < 5) return;
      moved = true;
      from = here;
      this.view.x -= dx / this.view.scale;
      this.view.y += dy / this.view.scale;
      this.fitted = false;
      this.draw();
    });
    canvas.addEventListener("pointerup", (event) => {
      if (from && !moved) this.onPick(this.robotAt([event.offsetX, event.offsetY]));
      from = null;
    });
    canvas.addEventListener("pointercancel", () => { from = null; });
    canvas.addEventListener("pointerleave", () => this.onPointer(null));
    canvas.addEventListener("dblclick", () => this.fit());
  }

  robotAt([px, py]) {
    let [best, nearest] = [null, 24];
    for (const robot of this.snapshot?.robots ?? []) {
      if (!robot.position_m || !this.view) continue;
      const [x, y] = this.toScreen(robot.position_m);
      const distance = Math.hypot(x - px, y - py);
      if (distance < nearest) [best, nearest] = [robot.name, distance];
    }
    return best;
  }

  draw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.paint();
    });
  }

  // The density, a pixel per cell; the first row is the highest y.
  paintDensity() {
    if (!this.known) return;
    const n = this.setup.density.cells;
    this.density ??= document.createElement("canvas");
    this.density.width = this.density.height = n;
    const image = new ImageData(n, n);
    for (let x = 0; x < n; x++) {
      for (let y = 0; y < n; y++) {
        const level = this.levels[x * n + y] * 3;
        const at = ((n - 1 - y) * n + x) * 4;
        image.data.set(this.table.subarray(level, level + 3), at);
        image.data[at + 3] = 255;
      }
    }
    this.density.getContext("2d").putImageData(image, 0, 0);
  }

  // Cells that no robot (or not the selected one) has explored, and the outline of the explored.
  paintVeil() {
    this.veilIsOld = false;
    const n = EXPLORED_CELLS;
    const own = this.explored.get(this.selected);
    const masks = own ? [own] : [...this.explored.values()];
    const seen = new Uint8Array(n * n);
    for (const mask of masks) for (let k = 0; k < seen.length; k++) seen[k] |= mask[k];
    const isSeen = (x, y) => x >= 0 && y >= 0 && x < n && y < n && seen[x * n + y];
    this.veil ??= document.createElement("canvas");
    this.veil.width = this.veil.height = n;
    const image = new ImageData(n, n);
    const [r, g, b] = this.ink.paper.match(/[\d.]+/g).map(Number);
    for (let x = 0; x < n; x++) {
      for (let y = 0; y < n; y++) {
        image.data.set([r, g, b, isSeen(x, y) ? 0 : 172], ((n - 1 - y) * n + x) * 4);
      }
    }
    this.veil.getContext("2d").putImageData(image, 0, 0);
    // Marching squares: through each square of four cells' centres, from side to side.
    this.edge = new Path2D();
    for (let x = -1; x < n; x++) {
      for (let y = -1; y < n; y++) {
        const corners = [isSeen(x, y), isSeen(x + 1, y), isSeen(x + 1, y + 1), isSeen(x, y + 1)];
        const sides = [[x + 1, y + 0.5], [x + 1.5, y + 1], [x + 1, y + 1.5], [x + 0.5, y + 1]];
        const crossed = sides.filter((_, k) => !corners[k] !== !corners[(k + 1) % 4]);
        for (let k = 0; k + 1 < crossed.length; k += 2) {
          this.edge.moveTo(...crossed[k]);
          this.edge.lineTo(...crossed[k + 1]);
        }
      }
    }
  }

  paint() {
    const c = this.context;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = this.ink.paper;
    c.fillRect(0, 0, w, h);
    if (!this.setup || !this.view) return;
    const robots = (this.snapshot?.robots ?? []).filter((robot) => robot.position_m);
    this.paintFence(c);
    this.paintWorld(c);
    // Below the robots, which must stay visible.
    this.paintNorth(c, w);
    this.paintScale(c, h);
    if (this.layers.cells) this.paintCells(c);
    if (this.layers.places) this.paintPlaces(c);
    if (this.layers.links) this.paintLinks(c);
    if (this.layers.paths) this.paintPaths(c);
    this.paintSelection(c, robots);
    if (this.layers.velocity) for (const robot of robots) this.paintVelocity(c, robot);
    // The selected robot lies on top.
    robots.sort((a, b) => (a.name === this.selected) - (b.name === this.selected));
    for (const robot of robots) this.paintRobot(c, robot);
    if (this.layers.names) for (const robot of robots) this.paintName(c, robot);
  }

  paintWorld(c) {
    const { side_m: side } = this.setup;
    const [x0, y1] = this.toScreen([0, 0]);
    const [x1, y0] = this.toScreen([side, side]);
    if (this.layers.density && this.known) {
      c.imageSmoothingEnabled = true;
      c.drawImage(this.density, x0, y0, x1 - x0, y1 - y0);
    } else {
      c.fillStyle = this.ink.field;
      c.fillRect(x0, y0, x1 - x0, y1 - y0);
    }
    if (this.veilIsOld) this.paintVeil();
    if (this.layers.explored) {
      c.drawImage(this.veil, x0, y0, x1 - x0, y1 - y0);
      const s = (x1 - x0) / EXPLORED_CELLS;
      const edge = new Path2D();
      edge.addPath(this.edge, new DOMMatrix([s, 0, 0, -s, x0, y1]));
      c.strokeStyle = this.explored.has(this.selected) ? this.ink.accent : this.ink.edge;
      c.lineWidth = 1.5;
      c.lineCap = "round";
      c.stroke(edge);
    }
    c.strokeStyle = this.ink.grid;
    c.lineWidth = 1;
    c.strokeRect(x0, y0, x1 - x0, y1 - y0);
    // Numbers along the world's two axes.
    const step = [1, 2, 5, 10, 20, 50, 100].find((m) => m * this.view.scale >= 56) ?? 200;
    c.fillStyle = this.ink.faint;
    c.font = "11px system-ui, sans-serif";
    for (let m = 0; m <= side + 1e-6; m += step) {
      const [x, y] = this.toScreen([m, m]);
      c.textAlign = "center";
      c.textBaseline = "top";
      this.label(c, `${m}`, x, y1 + 4);
      c.textAlign = "right";
      c.textBaseline = "middle";
      if (m > 0) this.label(c, `${m}`, x0 - 5, y);
    }
  }

  label(c, text, x, y) {
    c.lineJoin = "round";
    c.lineWidth = 4;
    c.strokeStyle = this.ink.halo;
    c.strokeText(text, x, y);
    c.fillText(text, x, y);
  }

  polygon(c, corners) {
    trace(c, corners.map((corner) => this.toScreen(corner)));
    c.closePath();
  }

  paintFence(c) {
    if (!this.snapshot) return;
    c.strokeStyle = this.ink.fence;
    c.lineWidth = 2;
    this.polygon(c, this.snapshot.fence);
    c.stroke();
    c.lineWidth = 1;
    c.setLineDash([5, 5]);
    this.polygon(c, this.snapshot.buffer);
    c.stroke();
    c.setLineDash([]);
  }

  paintCells(c) {
    c.strokeStyle = this.ink.ink;
    c.lineWidth = 1;
    c.globalAlpha = 0.38;
    for (const cell of Object.values(this.cells)) {
      if (cell.length < 3) continue;
      this.polygon(c, cell);
      c.stroke();
    }
    const own = this.cells[this.selected];
    if (own?.length >= 3) {
      c.globalAlpha = 1;
      c.lineWidth = 2;
      c.strokeStyle = this.ink.accent;
      this.polygon(c, own);
      c.stroke();
    }
    c.globalAlpha = 1;
  }

  paintPlaces(c) {
    c.lineWidth = 1.5;
    for (const slot of this.setup.slots) {
      const robot = this.snapshot?.robots.find(({ name }) => name === slot.robot);
      c.strokeStyle = slot.robot && slot.robot === this.selected ? this.ink.accent : this.ink.faint;
      c.fillStyle = this.ink.paper;
      const [px, py] = this.toScreen(slot.pad);
      c.fillRect(px - 5, py - 5, 10, 10);
      c.strokeRect(px - 5, py - 5, 10, 10);
      const [x, y] = this.toScreen(robot?.landing_m ?? slot.landing);
      circle(c, x, y, 6);
      c.fill();
      c.stroke();
      trace(c, [[x - 3, y - 3], [x + 3, y + 3]]);
      c.stroke();
      trace(c, [[x + 3, y - 3], [x - 3, y + 3]]);
      c.stroke();
    }
  }

  // The half of a link at a robot shows the age of the last message that the robot received.
  paintLinks(c) {
    const robots = this.snapshot?.robots ?? [];
    const heard = robots.map((robot) => new Map(robot.hears ?? []));
    c.lineCap = "butt";
    for (let a = 0; a < robots.length; a++) {
      for (let b = a + 1; b < robots.length; b++) {
        if (!robots[a].position_m || !robots[b].position_m) continue;
        if (!heard[a].has(b) && !heard[b].has(a)) continue;
        const from = this.toScreen(robots[a].position_m);
        const to = this.toScreen(robots[b].position_m);
        const middle = [(from[0] + to[0]) / 2, (from[1] + to[1]) / 2];
        const chosen = !this.selected || [robots[a].name, robots[b].name].includes(this.selected);
        this.paintHalf(c, from, middle, heard[a].get(b), chosen);
        this.paintHalf(c, to, middle, heard[b].get(a), chosen);
      }
    }
    c.setLineDash([]);
    c.globalAlpha = 1;
  }

  paintHalf(c, from, to, heard, chosen) {
    const grade = heard === undefined || heard === null ? 2 : AGES_S.findIndex((limit) => heard < limit);
    const n = grade < 0 ? 2 : grade;
    c.strokeStyle = this.ink[`age-${n}`];
    c.setLineDash(heard === undefined ? [2, 5] : n === 2 ? [7, 4] : []);
    c.lineWidth = n === 0 ? 1.5 : 2;
    c.globalAlpha = chosen ? (n === 0 ? 0.6 : 0.95) : 0.12;
    trace(c, [from, to]);
    c.stroke();
  }

  paintPaths(c) {
    c.lineJoin = "round";
    c.lineCap = "round";
    for (const [name, path] of this.paths) {
      const chosen = name === this.selected;
      c.strokeStyle = chosen ? this.ink.accent : this.ink.path;
      c.lineWidth = chosen ? 2.5 : 1.75;
      // In pieces that fade with age.
      const pieces = 8;
      const length = Math.ceil(path.length / pieces);
      for (let n = 0; n < pieces; n++) {
        const piece = path.slice(n * length, (n + 1) * length + 1);
        if (piece.length < 2) continue;
        c.globalAlpha = (chosen ? 0.95 : 0.75) * ((n + 1) / pieces) ** 1.5;
        trace(c, piece.map((point) => this.toScreen(point)));
        c.stroke();
      }
    }
    c.globalAlpha = 1;
  }

  paintSelection(c, robots) {
    const robot = robots.find(({ name }) => name === this.selected);
    if (!robot) return;
    const [x, y] = this.toScreen(robot.position_m);
    c.strokeStyle = this.ink.accent;
    c.lineWidth = 1;
    c.globalAlpha = 0.8;
    c.setLineDash([3, 4]);
    circle(c, x, y, this.setup.range_m * this.view.scale);
    c.stroke();
    const half = (this.setup.sensor_m / 2) * this.view.scale;
    c.strokeRect(x - half, y - half, 2 * half, 2 * half);
    c.setLineDash([]);
    if (robot.landing_m && this.layers.places) {
      trace(c, [[x, y], this.toScreen(robot.landing_m)]);
      c.stroke();
    }
    c.globalAlpha = 1;
  }

  get radius() {
    return Math.min(15, Math.max(9, 0.45 * this.view.scale));
  }

  paintVelocity(c, robot) {
    if (!robot.wanted_m_s || !robot.fresh) return;
    const [vx, vy] = robot.wanted_m_s;
    const speed = Math.hypot(vx, vy);
    if (speed < 0.03) return;
    const [x, y] = this.toScreen(robot.position_m);
    const [ux, uy] = [vx / speed, -vy / speed];
    const start = this.radius;
    const end = start + 6 + speed * ARROW_S * this.view.scale;
    const tip = [x + ux * end, y + uy * end];
    for (const [style, width] of [[this.ink.halo, 4.5], [this.ink.ink, 2]]) {
      c.strokeStyle = style;
      c.fillStyle = style;
      c.lineWidth = width;
      c.lineCap = "butt";
      trace(c, [[x + ux * start, y + uy * start], [tip[0] - ux * 5, tip[1] - uy * 5]]);
      c.stroke();
      trace(c, [
        tip,
        [tip[0] - ux * 9 - uy * 4.5, tip[1] - uy * 9 + ux * 4.5],
        [tip[0] - ux * 9 + uy * 4.5, tip[1] - uy * 9 - ux * 4.5],
      ]);
      c.closePath();
      if (style === this.ink.halo) c.lineWidth = 2.5;
      if (style === this.ink.halo) c.stroke();
      c.fill();
    }
  }

  // A circle in the air, a square on the ground; the nose leads; the letter is the state's.
  paintRobot(c, robot) {
    const [x, y] = this.toScreen(robot.position_m);
    const r = this.radius;
    const { look, letter, severity } = robot;
    c.save();
    c.translate(x, y);
    const ring = (ink, radius) => {
      c.strokeStyle = ink;
      c.lineWidth = 3;
      circle(c, 0, 0, radius);
      c.stroke();
    };
    if (severity === "critical") ring(this.ink.critical, r + 7);
    if (severity === "warning") ring(this.ink["age-1"], r + 7);
    if (robot.name === this.selected) ring(this.ink.accent, r + 4);
    c.lineJoin = "round";
    c.fillStyle = this.ink[look];
    const body = new Path2D();
    if (robot.in_air) body.arc(0, 0, r, 0, 2 * Math.PI);
    else body.roundRect(-r * 0.88, -r * 0.88, r * 1.76, r * 1.76, 3);
    const nose = new Path2D();
    if (robot.yaw_rad !== null) {
      const turned = new DOMMatrix().rotate((robot.yaw_rad * 180) / Math.PI);
      const tip = new Path2D();
      tip.moveTo(0, -r * 1.62);
      tip.lineTo(r * 0.72, -r * 0.72);
      tip.lineTo(-r * 0.72, -r * 0.72);
      tip.closePath();
      nose.addPath(tip, turned);
    }
    // Draw the halo and outline of both before filling, so that they form one shape.
    for (const [stroke, width] of [[this.ink.halo, 5], [this.ink.ink, 2.5]]) {
      c.strokeStyle = stroke;
      c.lineWidth = width;
      c.stroke(nose);
      c.stroke(body);
    }
    c.fill(nose);
    c.fill(body);
    c.fillStyle = DARK_ON.has(look) ? "#111" : "#fff";
    c.font = `700 ${Math.round(r * 1.25)}px system-ui, sans-serif`;
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText(letter, 0, r * 0.06);
    c.restore();
  }

  paintName(c, robot) {
    const [x, y] = this.toScreen(robot.position_m);
    const text = robot.fresh ? robot.name : `${robot.name} ${robot.cells.link[0]}`;
    c.font = `${robot.name === this.selected ? 700 : 600} 12px system-ui, sans-serif`;
    c.textAlign = "left";
    c.textBaseline = "middle";
    c.fillStyle = this.ink.ink;
    this.label(c, text, x + this.radius + 3, y + this.radius + 4);
  }

  paintNorth(c, w) {
    const heading = this.snapshot?.heading_deg;
    if (heading === null || heading === undefined) return;
    c.save();
    c.translate(w - 40, 44);
    c.fillStyle = this.ink.paper;
    c.strokeStyle = this.ink.grid;
    c.lineWidth = 1;
    c.globalAlpha = 0.85;
    circle(c, 0, 0, 26);
    c.fill();
    c.globalAlpha = 1;
    c.stroke();
    // The map's up is clockwise from north by the heading.
    const turn = (-heading * Math.PI) / 180;
    c.save();
    c.rotate(turn);
    c.fillStyle = this.ink.ink;
    trace(c, [[0, -14], [6, 12], [0, 7], [-6, 12]]);
    c.closePath();
    c.fill();
    c.restore();
    c.font = "700 11px system-ui, sans-serif";
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText("N", 20 * Math.sin(turn), -20 * Math.cos(turn));
    c.fillStyle = this.ink.faint;
    c.font = "11px system-ui, sans-serif";
    c.fillText(`up ${direction(heading)}`, 0, 36);
    c.restore();
  }

  paintScale(c, h) {
    const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
    const step = steps.find((m) => m * this.view.scale >= 60) ?? 200;
    const [x, y] = [16, h - 40];
    const length = step * this.view.scale;
    c.lineCap = "butt";
    for (const [style, width] of [[this.ink.halo, 6], [this.ink.ink, 2]]) {
      c.strokeStyle = style;
      c.lineWidth = width;
      trace(c, [[x, y - 5], [x, y], [x + length, y], [x + length, y - 5]]);
      c.stroke();
    }
    c.font = "600 12px system-ui, sans-serif";
    c.textAlign = "left";
    c.textBaseline = "middle";
    c.fillStyle = this.ink.ink;
    this.label(c, `${step} m`, x + length + 7, y - 2);
  }

  // Legend of the density's colours.
  paintRamp(canvas) {
    const c = canvas.getContext("2d");
    for (let x = 0; x < canvas.width; x++) {
      const at = Math.round((255 * x) / (canvas.width - 1)) * 3;
      c.fillStyle = `rgb(${this.table.subarray(at, at + 3).join(" ")})`;
      c.fillRect(x, 0, 1, canvas.height);
    }
  }
}
