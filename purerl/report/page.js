"use strict";
// Toggles, the choice of scale, and values under the pointer. The page is whole without it.

const data = JSON.parse(document.getElementById("data").textContent);
const tip = document.getElementById("tip");

function shows(box) {
  return box.checked && (!box.dataset.of || document.getElementById(box.dataset.of).checked);
}

function update() {
  const off = new Set();
  for (const box of document.querySelectorAll("input[data-key]")) {
    if (!shows(box)) off.add(box.dataset.key);
  }
  for (const path of document.querySelectorAll("path[data-group]")) {
    path.classList.toggle("off", off.has(`${path.dataset.group}/${path.dataset.run}`));
  }
  const log = document.getElementById("log");
  document.body.classList.toggle("log", Boolean(log && log.checked));
  return off;
}

function nearest(steps, wanted) {
  let best = 0;
  for (let i = 1; i < steps.length; i++) {
    if (Math.abs(steps[i] - wanted) < Math.abs(steps[best] - wanted)) best = i;
  }
  return best;
}

function number(value) {
  return Number(value.toPrecision(5)).toLocaleString("en-US", { maximumSignificantDigits: 5 });
}

function line(series, at) {
  const row = document.createElement("div");
  const swatch = document.createElement("span");
  swatch.className = `swatch ${series.look}`;
  const spread = series.low ? ` [${number(series.low[at])}, ${number(series.high[at])}]` : "";
  row.append(swatch, `${series.label}: ${number(series.values[at])}${spread}`);
  return row;
}

function point(event) {
  const figure = event.currentTarget;
  const svg = figure.querySelector("svg");
  const box = svg.getBoundingClientRect();
  const { left, right, last } = svg.dataset;
  const scale = svg.viewBox.baseVal.width / box.width;
  const across = ((event.clientX - box.left) * scale - left) / (right - left);
  const wanted = Math.min(1, Math.max(0, across)) * last;
  const off = update();
  const shown = data[figure.dataset.panel].filter((s) => !off.has(s.key));
  if (!shown.length) return leave(event);
  const found = shown.map((s) => s.steps[nearest(s.steps, wanted)]);
  const steps = found[nearest(found, wanted)];
  const x = Number(left) + (steps / last) * (right - left);
  const cursor = figure.querySelector(".cursor");
  cursor.setAttribute("x1", x);
  cursor.setAttribute("x2", x);
  cursor.classList.remove("off");
  const head = document.createElement("b");
  head.textContent = `${steps.toLocaleString("en-US")} steps`;
  tip.replaceChildren(head, ...shown.slice(0, 20).map((s) => line(s, nearest(s.steps, steps))));
  tip.classList.remove("off");
  const room = document.documentElement.clientWidth - tip.offsetWidth - 8;
  tip.style.left = `${Math.max(8, Math.min(event.clientX + 16, room))}px`;
  const below = event.clientY + 16 + tip.offsetHeight < window.innerHeight;
  tip.style.top = `${below ? event.clientY + 16 : Math.max(8, event.clientY - tip.offsetHeight - 16)}px`;
}

function leave(event) {
  tip.classList.add("off");
  event.currentTarget.querySelector(".cursor").classList.add("off");
}

for (const box of document.querySelectorAll("input[type=checkbox]")) box.addEventListener("change", update);
for (const figure of document.querySelectorAll("figure[data-panel]")) {
  figure.addEventListener("pointermove", point);
  figure.addEventListener("pointerleave", leave);
}
document.body.classList.add("live"); // the controls do something
update(); // a browser keeps boxes as they were before a reload
