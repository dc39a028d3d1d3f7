// SPDX-License-Identifier: Apache-2.0
// Draws what `watch` sends: samples [t, θ, θ model, ω, ω model, i, i model, v, v model, duty, reference] and states.
"use strict";

const byId = id => document.getElementById(id);
const CHANNELS = [["angle", "rad", 1], ["speed", "rad/s", 3], ["current", "A", 5], ["voltage", "V", 7]];
const view = { samples: [], seconds: 60, state: null, paused: false, link: "connecting", drawn: 0, ages: [], fresh: false };
window.aeropend = view; // for tests

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.onopen = () => { view.link = "open"; connect.wait = 500; };
  socket.onmessage = event => take(JSON.parse(event.data));
  socket.onclose = () => {
    view.link = "lost";
    tell();
    connect.wait = Math.min((connect.wait || 500) * 1.5, 5000);
    setTimeout(connect, connect.wait);
  };
}

function take(message) {
  if (message.hello) {
    view.seconds = message.hello.seconds;
    view.model = message.hello.model;
    view.samples = [];
  }
  if (message.samples) {
    if (view.paused) return;
    const last = view.samples.length ? view.samples[view.samples.length - 1][0] : -Infinity;
    if (message.samples.length && message.samples[0][0] < last) view.samples = [];
    view.samples.push(...message.samples);
    const newest = view.samples[view.samples.length - 1];
    let old = 0;
    while (old < view.samples.length && view.samples[old][0] < newest[0] - view.seconds) old++;
    if (old) view.samples.splice(0, old);
    view.fresh = true;
  }
  if (message.state) {
    view.state = message.state;
    tell();
  }
}

function element(tag, text, className) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

const clock = seconds => seconds ? new Date(seconds * 1000).toLocaleTimeString() : "";
const short = x => x === null || x === undefined ? "–" : Number(x).toPrecision(3);

function tell() {
  const verdict = byId("verdict"), s = view.state;
  if (view.link !== "open") {
    verdict.className = "warn";
    verdict.textContent = "no connection to watch: trying again";
    return;
  }
  if (!s) return;
  const parted = Object.entries(s.places).filter(([, p]) => p.state === "parted");
  if (parted.length) {
    const [place, p] = parted[0];
    verdict.className = "bad";
    verdict.textContent = `parted at ${place} since ${clock(p.since)}: ${p.effect} (${Math.round(100 * p.probability)} %)`;
    const last = s.history[s.history.length - 1];
    if (last && last.diagnosed) verdict.textContent += `; diagnose of the minute around it: ${last.diagnosed}`;
  } else if (s.note) {
    verdict.className = "warn";
    verdict.textContent = s.note;
  } else {
    verdict.className = "good";
    verdict.textContent = "rig and model agree";
  }
  if (parted.length && s.note) verdict.textContent += `; ${s.note}`;
  const rows = Object.entries(s.places).map(([name, p]) => {
    const row = element("tr", undefined, p.state.split(" ")[0]);
    row.append(element("th", name));
    const cell = element("td"), bar = element("div", undefined, "bar"), fill = element("i");
    const share = p.limit ? Math.min(p.gap / p.limit / 1.5, 1) : 0;
    fill.style.width = `${100 * share}%`;
    bar.append(fill, element("b"));
    bar.setAttribute("role", "img");
    bar.setAttribute("aria-label", `gap ${short(p.gap)}, limit ${short(p.limit)} floors`);
    const limit = p.limit === null ? "" : ` of ${short(p.limit)}`;
    const effect = p.effect ? `, ${p.effect} ${Math.round(100 * p.probability)} %` : "";
    const since = p.since ? `, since ${clock(p.since)}` : "";
    cell.append(bar, element("div", `${p.state}: ${short(p.gap)}${limit} floors${effect}${since}`, "what"));
    row.append(cell);
    return row;
  });
  byId("places").replaceChildren(...rows);
  const history = s.history.slice().reverse().map(h => element("li",
    `${clock(h.since)} ${h.place}: ${h.effect} (${Math.round(100 * h.probability)} %), told at ${clock(h.at)}` +
    (h.diagnosed ? `; diagnose: ${h.diagnosed}` : "")));
  byId("history").replaceChildren(...(history.length ? history : [element("li", "none so far")]));
  const nodes = Object.entries(s.nodes).map(([name, n]) => element("li",
    `${name}: ${n.message}${n.reference ? `, reference ${n.reference}` : ""}`));
  byId("nodes").replaceChildren(...(nodes.length ? nodes : [element("li", "none heard")]));
}

function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const width = Math.round(box.width * ratio), height = Math.round(box.height * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, box.width, box.height);
  return [g, box.width, box.height];
}

function drawArm(colors) {
  const [g, w, h] = prepared(byId("arm"));
  const last = view.samples[view.samples.length - 1];
  const length = Math.min(0.72 * h, 0.42 * w), x0 = 0.4 * w, y0 = 0.12 * h;
  g.strokeStyle = colors.line;
  g.lineWidth = 1;
  g.beginPath();
  g.moveTo(x0, y0); g.lineTo(x0, y0 + 1.1 * length);
  g.stroke();
  g.beginPath();
  for (let a = 0; a <= 90; a += 15) {
    const s = Math.sin(a * Math.PI / 180), c = Math.cos(a * Math.PI / 180);
    g.moveTo(x0 + 1.04 * length * s, y0 + 1.04 * length * c);
    g.lineTo(x0 + 1.1 * length * s, y0 + 1.1 * length * c);
  }
  g.stroke();
  if (!last) return;
  for (const [theta, color, width, alpha] of [[last[2], colors.model, 9, .55], [last[1], colors.measured, 5, 1]]) {
    if (theta === null) continue;
    const s = Math.sin(theta), c = Math.cos(theta), x = x0 + length * s, y = y0 + length * c;
    g.globalAlpha = alpha;
    g.strokeStyle = color;
    g.lineWidth = width;
    g.lineCap = "round";
    g.beginPath();
    g.moveTo(x0, y0); g.lineTo(x, y);
    g.moveTo(x - .16 * length * s, y - .16 * length * c); g.lineTo(x + .16 * length * s, y + .16 * length * c);
    g.stroke();
    g.globalAlpha = 1;
  }
  g.fillStyle = colors.text;
  g.beginPath();
  g.arc(x0, y0, 6, 0, 7);
  g.fill();
  const now = byId("now"), items = [];
  for (const [name, unit, at] of CHANNELS) {
    items.push(element("dt", `${name} [${unit}]`), element("dd", short(last[at]), "a"), element("dd", short(last[at + 1]), "b"));
  }
  items.push(element("dt", "duty"), element("dd", short(last[9]), "a"), element("dd", ""));
  now.replaceChildren(...items);
}

function drawTraces(colors) {
  const [g, w, h] = prepared(byId("trace"));
  const s = view.samples;
  if (!s.length) return;
  const end = s[s.length - 1][0], left = 64, each = h / CHANNELS.length;
  g.font = "12px system-ui, sans-serif";
  CHANNELS.forEach(([name, unit, at], k) => {
    const top = k * each + 4, height = each - 14;
    let low = Infinity, high = -Infinity;
    for (const row of s) for (const j of [at, at + 1]) if (row[j] !== null) {
      low = Math.min(low, row[j]); high = Math.max(high, row[j]);
    }
    if (!(high > low)) { high = low + 1; }
    const pad = 0.05 * (high - low);
    low -= pad; high += pad;
    g.strokeStyle = colors.line;
    g.lineWidth = 1;
    g.strokeRect(left, top, w - left - 4, height);
    g.fillStyle = colors.faint;
    g.textAlign = "right";
    g.fillText(high.toPrecision(3), left - 6, top + 10);
    g.fillText(low.toPrecision(3), left - 6, top + height);
    g.fillText(name, left - 6, top + height / 2 - 4);
    g.fillText(unit, left - 6, top + height / 2 + 10);
    const lines = [[at + 1, colors.model, 2.5], [at, colors.measured, 1.2]];
    if (at === 1) lines.unshift([10, colors.faint, 1]);
    for (const [j, color, width] of lines) {
      g.strokeStyle = color;
      g.lineWidth = width;
      g.beginPath();
      let down = false, before = -Infinity;
      for (const row of s) {
        if (row[j] === null || row[0] - before > 0.5) down = false;
        before = row[0];
        if (row[j] === null) continue;
        const x = left + (w - left - 4) * (1 - (end - row[0]) / view.seconds);
        const y = Math.min(Math.max(top + height * (1 - (row[j] - low) / (high - low)), top), top + height);
        if (down) g.lineTo(x, y); else g.moveTo(x, y);
        down = true;
      }
      g.stroke();
    }
  });
}

function colorsNow() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(["measured", "model", "line", "text", "faint"].map(n => [n, style.getPropertyValue(`--${n}`).trim()]));
}

function frame() {
  if (view.fresh) {
    view.fresh = false;
    const colors = colorsNow();
    drawArm(colors);
    drawTraces(colors);
    view.drawn++;
    const last = view.samples[view.samples.length - 1];
    if (last) view.ages.push(Date.now() - last[0] * 1000);
    if (view.ages.length > 300) view.ages.shift();
    if (view.drawn % 30 === 0) {
      const sorted = view.ages.slice().sort((a, b) => a - b);
      view.p95 = sorted[Math.floor(0.95 * (sorted.length - 1))];
      byId("foot").textContent = `model ${view.model}; from sample to picture ${Math.round(view.p95)} ms (95 %), by the clocks of rig and viewer`;
    }
  }
  requestAnimationFrame(frame);
}

function pause() {
  view.paused = !view.paused;
  byId("pause").setAttribute("aria-pressed", view.paused);
  byId("pause").textContent = view.paused ? "Go on" : "Pause";
}

function theme() {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
  view.fresh = true;
}

byId("pause").onclick = pause;
byId("theme").onclick = theme;
addEventListener("keydown", event => {
  if (event.target.tagName === "BUTTON" && event.key === " ") return;
  if (event.key === " ") { event.preventDefault(); pause(); }
  if (event.key === "d") theme();
});
addEventListener("resize", () => { view.fresh = true; });
connect();
requestAnimationFrame(frame);
