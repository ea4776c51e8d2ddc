// Small helpers for the page. What the fleet says is only ever put in as text, never as HTML.

export const $ = (selector) => document.querySelector(selector);

// An element with a class, and children: elements or texts.
export function make(tag, className = "", ...children) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  element.append(...children);
  return element;
}

// Only what changes is touched, so that a text can be selected while the page is live.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function setClass(element, className) {
  if (element.className !== className) element.className = className;
}

const kept = new WeakMap();

// Children of `parent` by key: makes, keeps, reorders and removes them.
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

// A number with as many decimals, or a dash.
export function number(value, digits = 0, unit = "") {
  return value === null || value === undefined ? "–" : value.toFixed(digits) + unit;
}

// Degrees, below 360 also rounded.
export function direction(degrees) {
  return `${((Math.round(degrees) % 360) + 360) % 360}°`;
}

export function clock(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}
