// Coverage cost of the trial over the mission time, and that of Lloyd's algorithm, which knows the
// world.

import { circle, clock, colour, trace } from "./dom.js";

const LEFT = 30;
const RIGHT = 12;
const TOP = 8;
const BOTTOM = 18;

export class Chart {
  constructor(canvas) {
    this.canvas = canvas;
    this.points = [];
    this.lloyd = null;
    new ResizeObserver(() => this.paint()).observe(canvas);
  }

  set(points, lloyd) {
    this.points = points;
    this.lloyd = lloyd;
    this.paint();
  }

  paint() {
    const { canvas } = this;
    const { clientWidth: w, clientHeight: h } = canvas;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
    const c = canvas.getContext("2d");
    c.scale(ratio, ratio);
    const [ink, faint, grid, accent, lloyd] =
      ["ink", "faint", "grid", "accent", "lloyd"].map(colour);
    const last = this.points.at(-1);
    const end = Math.max(60, (last?.[0] ?? 0) * 1.08);
    const highest = Math.max(1, ...this.points.map(([, share]) => share)) * 1.04;
    const x = (time) => LEFT + ((w - LEFT - RIGHT) * time) / end;
    const y = (share) => h - BOTTOM - ((h - BOTTOM - TOP) * share) / highest;
    c.font = "11px system-ui, sans-serif";
    c.fillStyle = faint;
    c.strokeStyle = grid;
    c.lineWidth = 1;
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const share of [0, 0.5, 1]) {
      trace(c, [[LEFT, y(share)], [w - RIGHT, y(share)]]);
      c.stroke();
      c.fillText(share.toFixed(1), LEFT - 6, y(share));
    }
    c.textBaseline = "alphabetic";
    const step = [10, 15, 30, 60, 120, 300, 600].find((s) => end / s <= 5) ?? 1800;
    for (let time = 0; time <= end; time += step) {
      c.textAlign = time === 0 ? "left" : "center";
      c.fillText(clock(time), x(time), h - 4);
    }
    if (this.lloyd !== null) {
      c.strokeStyle = lloyd;
      c.lineWidth = 2;
      c.setLineDash([6, 4]);
      trace(c, [[LEFT, y(this.lloyd)], [w - RIGHT, y(this.lloyd)]]);
      c.stroke();
      c.setLineDash([]);
    }
    if (!last) {
      c.fillStyle = faint;
      c.textAlign = "center";
      c.fillText("from the mission's start", (LEFT + w - RIGHT) / 2, y(0.5) - 8);
      return;
    }
    c.strokeStyle = accent;
    c.lineWidth = 2.25;
    c.lineJoin = "round";
    trace(c, this.points.map(([time, share]) => [x(time), y(share)]));
    c.stroke();
    c.fillStyle = ink;
    circle(c, x(last[0]), y(last[1]), 3.5);
    c.fill();
  }
}
