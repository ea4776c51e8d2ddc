// Small helpers for the page. Content from the fleet is inserted as text only, never as HTML.

export const $ = (selector) => document.querySelector(selector);

// Makes an element with a class and children (elements or texts).
export function make(tag, className = "", ...children) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  element.append(...children);
  return element;
}

// Changes only what differs, so that text can be selected while the page is live.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function setClass(element, className) {
  if (element.className !== className) element.className = className;
}

const kept = new WeakMap();

// Synchronises the children of `parent` by key: makes, keeps, reorders and removes them.
export function sync(parent, items, keyOf, create, update) {
  if (!kept.has(parent)) kept.set(parent, new Map());
  const rows = kept.get(parent);
  const seen = new Set();
  let place = parent.firstElementChild;
  for (const item of items) {
    const key = keyOf(item);
    if (seen.has(key)) continue;
    seen.add(key);
    let row = rows.get(key);
    if (!row) rows.set(key, (row = create(item)));
    update(row, item);
    if (row === place) place = place.nextElementSibling;
    else parent.insertBefore(row, place);
  }
  for (const [key, row] of rows) {
    if (!seen.has(key)) {
      row.remove();
      rows.delete(key);
    }
  }
}

// A colour of the style sheet, for a canvas: what `var(--name)` is in the present theme.
export function colour(name) {
  const probe = $("#probe") ?? document.body.appendChild(make("i"));
  probe.id = "probe";
  probe.style.color = `var(--${name})`;
  return getComputedStyle(probe).color;
}

// Formats a number with that many decimals, or a dash.
export function number(value, digits) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

// Formats degrees in [0, 360), also after rounding.
export function direction(degrees) {
  return `${((Math.round(degrees) % 360) + 360) % 360}°`;
}

export function clock(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

// Begins a path through points on a canvas.
export function trace(c, points) {
  c.beginPath();
  points.forEach(([x, y], n) => c[n ? "lineTo" : "moveTo"](x, y));
}

export function circle(c, x, y, radius) {
  c.beginPath();
  c.arc(x, y, radius, 0, 2 * Math.PI);
}
