"use strict";
const D = JSON.parse(document.getElementById("data").textContent);
const COLOURS = ["#2f6fde", "#e0702b", "#2a9d5c", "#c9354a", "#8457c9", "#a9772c", "#d254a3", "#7a8899", "#1fa3b5", "#93a51f"];
const STATUS = { moving: "#2f6fde", arrived: "#2a9d5c", shadowed: "#e0a12b", local_minimum: "#c9354a", saturated: "#8457c9", singular: "#d254a3", limited: "#a9772c" };
const STATE = { IDLE: "#9aa7b6", ARMED: "#e0a12b", RUN: "#2a9d5c", STOPPING: "#e0702b", SAFE_STOP: "#c9354a", FAULT: "#7d0f20" };
const time = D.time, N = time.length, END = Math.max(D.duration, 1e-6), T0 = time[0] || 0;
const view = { a: T0, b: T0 + END };
let cursor = null, series = {};
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

async function unpack() {
  const raw = Uint8Array.from(atob(D.packed), c => c.charCodeAt(0));
  const stream = new Blob([raw]).stream().pipeThrough(new DecompressionStream("deflate"));
  const codes = new Uint16Array(await new Response(stream).arrayBuffer());
  for (const [name, [k, low, scale]] of Object.entries(D.series)) {
    const out = [];
    for (let half = 0; half < 2; half++) {
      const values = new Float64Array(N);
      let code = 0;
      for (let i = 0; i < N; i++) {
        code = (code + codes[(2 * k + half) * N + i]) & 0xffff;
        values[i] = code === 65535 ? NaN : low + scale * code;
      }
      out.push(values);
    }
    series[name] = out;
  }
}

function paper(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2), w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  const c = canvas.getContext("2d");
  c.setTransform(ratio, 0, 0, ratio, 0, 0); c.clearRect(0, 0, w, h);
  c.font = "11px system-ui, DejaVu Sans, sans-serif";
  return [c, w, h];
}

function number(v) {
  if (v === null || !isFinite(v)) return "-";
  const a = Math.abs(v);
  if (a !== 0 && (a < 1e-3 || a >= 1e5)) return v.toExponential(1).replace("e-", "e−");
  return String(+v.toPrecision(a < 1 ? 3 : 4));
}

function ticks(a, b, count) {
  const raw = (b - a) / count, base = 10 ** Math.floor(Math.log10(raw)), m = raw / base;
  const step = base * (m < 1.5 ? 1 : m < 3.5 ? 2 : m < 7.5 ? 5 : 10), out = [];
  for (let v = Math.ceil(a / step) * step; v <= b + 1e-9 * step; v += step) out.push(+v.toFixed(12));
  return out;
}

const LEFT = 54, RIGHT = 10, TOP = 8, BOTTOM = 20;
const X = (t, w) => LEFT + (t - view.a) / (view.b - view.a) * (w - LEFT - RIGHT);
const timeAt = (x, w) => view.a + (x - LEFT) / (w - LEFT - RIGHT) * (view.b - view.a);
const indexAt = t => { let a = 0, b = N - 1; while (a < b) { const m = (a + b + 1) >> 1; if (time[m] <= t) a = m; else b = m - 1; } return a; };

function bands(c, w, h, spans, colours, alpha, top, bottom) {
  c.globalAlpha = alpha;
  for (const [a, b, name] of spans) {
    if (b < view.a || a > view.b) continue;
    c.fillStyle = colours[name] || "#9aa7b6";
    const x0 = Math.max(X(a, w), LEFT), x1 = Math.min(X(b, w), w - RIGHT);
    c.fillRect(x0, top, Math.max(x1 - x0, 0.6), bottom - top);
  }
  c.globalAlpha = 1;
}

function axes(c, w, h, low, high, log, unit) {
  const Y = v => h - BOTTOM - (v - low) / (high - low) * (h - TOP - BOTTOM);
  c.strokeStyle = css("--line"); c.fillStyle = css("--soft"); c.lineWidth = 1;
  c.textAlign = "right"; c.textBaseline = "middle";
  const marks = log ? ticks(low, high, 4).filter(Number.isInteger) : ticks(low, high, Math.max(3, h / 50));
  for (const v of marks) {
    const y = Y(v);
    c.beginPath(); c.moveTo(LEFT, y); c.lineTo(w - RIGHT, y); c.stroke();
    c.fillText(log ? number(10 ** v) : number(v), LEFT - 5, y);
  }
  c.textAlign = "center"; c.textBaseline = "top";
  for (const t of ticks(view.a, view.b, Math.max(2, w / 110))) {
    const x = X(t, w);
    c.beginPath(); c.moveTo(x, h - BOTTOM); c.lineTo(x, h - BOTTOM + 4); c.stroke();
    c.fillText(number(t), x, h - BOTTOM + 5);
  }
  return Y;
}

class Plot {
  constructor(spec, host) {
    this.spec = spec; this.off = new Set();
    this.figure = document.createElement("figure");
    this.figure.id = "plot-" + spec.id;
    const caption = document.createElement("figcaption"), title = document.createElement("span");
    title.textContent = spec.title + (spec.unit ? ` [${spec.unit}]` : "");
    this.legend = document.createElement("span"); this.legend.className = "legend";
    caption.append(title, this.legend);
    this.canvas = document.createElement("canvas");
    this.figure.append(caption, this.canvas); host.append(this.figure);
    this.labels = spec.series.map(([name, label, colour]) => {
      const b = document.createElement("button"), i = document.createElement("i"), s = document.createElement("span");
      b.type = "button"; i.style.background = COLOURS[colour % COLOURS.length]; s.textContent = label;
      b.append(i, s);
      b.addEventListener("click", () => { this.off.has(name) ? this.off.delete(name) : this.off.add(name); b.classList.toggle("off"); this.draw(); });
      this.legend.append(b);
      return s;
    });
    this.visible = false;
    drags(this.canvas);
  }
  range(shown, i0, i1) {
    const s = this.spec;
    let low = Infinity, high = -Infinity, small = Infinity;
    for (const [name] of shown) {
      const [a, b] = series[name];
      for (let i = i0; i <= i1; i++) {
        if (a[i] < low) low = a[i];
        if (b[i] > high) high = b[i];
        if (a[i] > 0 && a[i] < small) small = a[i];
      }
    }
    if (!isFinite(low)) return [0, 1];
    if (s.log) {
      high = Math.max(high, small * 1.01, 1e-9);
      low = Math.max(isFinite(small) ? small : high / 1e3, high / 1e6);
      return [Math.floor(Math.log10(low) * 2) / 2, Math.log10(high) + 0.15];
    }
    if (s.top !== undefined && high > s.top) high = Math.max(s.top, low + 1e-3);
    if (s.zero) low = Math.min(low, 0);
    for (const v of s.lines || []) if (Math.abs(v) < 2.5 * Math.max(Math.abs(low), Math.abs(high))) { low = Math.min(low, v); high = Math.max(high, v); }
    const pad = (high - low || Math.abs(high) || 1) * 0.06;
    return [s.zero && low === 0 ? 0 : low - pad, high + pad];
  }
  draw() {
    if (!this.visible) return;
    const s = this.spec, [c, w, h] = paper(this.canvas);
    const i0 = Math.max(0, indexAt(view.a) - 1), i1 = Math.min(N - 1, indexAt(view.b) + 1);
    const shown = s.series.filter(([name]) => !this.off.has(name));
    bands(c, w, h, D.statuses, STATUS, 0.11, TOP, h - BOTTOM);
    const [low, high] = this.range(shown, i0, i1);
    const Y = axes(c, w, h, low, high, s.log, s.unit);
    c.save(); c.beginPath(); c.rect(LEFT, TOP - 2, w - LEFT - RIGHT, h - TOP - BOTTOM + 4); c.clip();
    if (s.zero && low <= 0) { c.strokeStyle = css("--soft"); c.beginPath(); c.moveTo(LEFT, Y(0)); c.lineTo(w - RIGHT, Y(0)); c.stroke(); }
    c.setLineDash([6, 4]); c.strokeStyle = "#c9354a";
    for (const v of s.lines || []) { c.beginPath(); c.moveTo(LEFT, Y(v)); c.lineTo(w - RIGHT, Y(v)); c.stroke(); }
    c.setLineDash([]);
    const f = s.log ? v => Y(Math.log10(Math.max(v, 1e-12))) : Y;
    for (const [name, , colour, dashed] of shown) this.line(c, w, series[name], f, COLOURS[colour % COLOURS.length], dashed, i0, i1);
    for (const [a, b] of D.faults) if (b >= view.a && a <= view.b) { c.fillStyle = "#c9354a"; c.globalAlpha = 0.25; c.fillRect(X(a, w), TOP, Math.max(1.5, X(b, w) - X(a, w)), h - TOP - BOTTOM); c.globalAlpha = 1; }
    c.restore();
    if (cursor !== null && cursor >= view.a && cursor <= view.b) {
      c.strokeStyle = css("--ink"); c.globalAlpha = 0.5; c.beginPath(); c.moveTo(X(cursor, w), TOP); c.lineTo(X(cursor, w), h - BOTTOM); c.stroke(); c.globalAlpha = 1;
    }
    this.read();
    if (drag && drag.canvas === this.canvas) { c.fillStyle = css("--accent"); c.globalAlpha = 0.2; c.fillRect(Math.min(drag.from, drag.to), TOP, Math.abs(drag.to - drag.from), h - TOP - BOTTOM); c.globalAlpha = 1; }
  }
  line(c, w, [a, b], f, colour, dashed, i0, i1) {
    c.strokeStyle = colour; c.lineWidth = 1.4; c.setLineDash(dashed ? [5, 4] : []);
    c.beginPath();
    let down = false;
    for (let i = i0; i <= i1; i++) {
      if (isNaN(a[i])) { down = false; continue; }
      const x = X(time[i], w), y0 = f(a[i]), y1 = f(b[i]);
      if (down) c.lineTo(x, y1); else c.moveTo(x, y1);
      if (Math.abs(y0 - y1) > 0.7) c.lineTo(x, y0);
      down = true;
    }
    c.stroke(); c.setLineDash([]);
  }
  read() {
    this.spec.series.forEach(([name, label], k) => {
      const i = cursor === null ? -1 : indexAt(cursor);
      this.labels[k].textContent = i < 0 ? label : `${label} ${number(series[name][1][i])}`;
    });
  }
}

let drag = null;
function redraw() { for (const p of plots) p.draw(); timeline(); scene(); bus(); }
let asked = false;
function later() { if (!asked) { asked = true; requestAnimationFrame(() => { asked = false; redraw(); }); } }
function zoom(a, b) {
  if (b - a < END / 2e4) return;
  view.a = Math.max(T0, a); view.b = Math.min(T0 + END, b); later();
}
function drags(canvas) {
  canvas.addEventListener("pointerdown", e => { if (e.pointerType === "mouse") { drag = { canvas, from: e.offsetX, to: e.offsetX }; canvas.setPointerCapture(e.pointerId); } });
  canvas.addEventListener("pointermove", e => { cursor = timeAt(e.offsetX, canvas.clientWidth); if (drag && drag.canvas === canvas) drag.to = e.offsetX; later(); });
  canvas.addEventListener("pointerup", e => {
    if (drag && drag.canvas === canvas && Math.abs(drag.to - drag.from) > 6) {
      const w = canvas.clientWidth, t = [timeAt(drag.from, w), timeAt(drag.to, w)].sort((p, q) => p - q);
      drag = null; zoom(t[0], t[1]);
    } else { drag = null; cursor = timeAt(e.offsetX, canvas.clientWidth); later(); }
  });
  canvas.addEventListener("pointerleave", () => { if (!drag) { cursor = null; later(); } });
  canvas.addEventListener("dblclick", () => zoom(T0, T0 + END));
  canvas.addEventListener("wheel", e => {
    if (!e.ctrlKey && !e.shiftKey) return;
    e.preventDefault();
    const t = timeAt(e.offsetX, canvas.clientWidth), k = e.deltaY > 0 ? 1.25 : 0.8;
    zoom(t - (t - view.a) * k, t + (view.b - t) * k);
  }, { passive: false });
}

function timeline() {
  const canvas = document.getElementById("timeline"), [c, w, h] = paper(canvas);
  const rows = [[D.states, STATE, "state"], [D.statuses, STATUS, "status"], [D.faults, new Proxy({}, { get: () => "#c9354a" }), "fault"]];
  const size = (h - BOTTOM) / rows.length;
  rows.forEach(([spans, colours, name], k) => {
    c.fillStyle = css("--soft"); c.textAlign = "right"; c.textBaseline = "middle"; c.fillText(name, LEFT - 5, size * (k + 0.5));
    c.fillStyle = css("--line"); c.fillRect(LEFT, size * k + 2, w - LEFT - RIGHT, size - 4);
    bands(c, w, h, spans, colours, 0.9, size * k + 2, size * (k + 1) - 2);
  });
  c.fillStyle = css("--soft"); c.textAlign = "center"; c.textBaseline = "top";
  for (const t of ticks(view.a, view.b, Math.max(2, w / 110))) c.fillText(number(t) + " s", X(t, w), h - BOTTOM + 4);
  if (cursor !== null) { c.strokeStyle = css("--ink"); c.beginPath(); c.moveTo(X(cursor, w), 0); c.lineTo(X(cursor, w), h - BOTTOM); c.stroke(); }
}

function keys() {
  const host = document.getElementById("keys"), seen = new Map();
  for (const [, , name] of D.states) seen.set(name, STATE[name]);
  for (const [, , name] of D.statuses) seen.set(name.replace("_", " "), STATUS[name]);
  for (const [, , name] of D.faults) seen.set(name, "#c9354a");
  for (const [name, colour] of seen) {
    if (name === "no goal") continue;
    const s = document.createElement("span"), i = document.createElement("i");
    i.style.background = colour || "#9aa7b6"; s.append(i, name); host.append(s);
  }
}

const eye = { yaw: -0.9, pitch: 0.45 };
const VIEWS = { iso: [-0.9, 0.45], top: [-Math.PI / 2, Math.PI / 2], front: [0, 0], side: [-Math.PI / 2, 0] };
function rotated(q, p) {
  const [w, x, y, z] = q, [a, b, c] = p, tx = 2 * (y * c - z * b), ty = 2 * (z * a - x * c), tz = 2 * (x * b - y * a);
  return [a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx];
}
function wires(way) {
  const [a, b, cc] = way.dims, p = way.path[way.path.length - 1], out = [];
  const ring = (rx, ry, f) => { const r = []; for (let i = 0; i <= 32; i++) { const t = i / 16 * Math.PI; r.push(f(rx * Math.cos(t), ry * Math.sin(t))); } out.push(r); };
  const t = way.type;
  if (t === "plane") return [];
  if (t === "box") {
    for (const z of [-cc, cc]) out.push([[-a, -b, z], [a, -b, z], [a, b, z], [-a, b, z], [-a, -b, z]]);
    for (const [x, y] of [[-a, -b], [a, -b], [a, b], [-a, b]]) out.push([[x, y, -cc], [x, y, cc]]);
  } else if (t === "sphere" || t === "point" || t === "ellipsoid" || t === "n_ellipsoid") {
    const r = t === "sphere" ? [a, a, a] : t === "point" ? [0.005, 0.005, 0.005] : [a, b, cc];
    ring(r[0], r[1], (u, v) => [u, v, 0]); ring(r[0], r[2], (u, v) => [u, 0, v]); ring(r[1], r[2], (u, v) => [0, u, v]);
  } else if (t === "capsule" || t === "segment" || t === "cylinder" || t === "cone" || t === "n_cylinder") {
    const r0 = a, r1 = t === "cone" ? b : a, ry = t === "n_cylinder" ? b : null, l = t === "cone" || t === "n_cylinder" ? cc : b;
    ring(r0, ry || r0, (u, v) => [u, v, -l]); ring(r1, ry || r1, (u, v) => [u, v, l]);
    for (const k of [0, 8, 16, 24]) { const f = k / 16 * Math.PI; out.push([[r0 * Math.cos(f), (ry || r0) * Math.sin(f), -l], [r1 * Math.cos(f), (ry || r1) * Math.sin(f), l]]); }
    if (t === "capsule") for (const e of [-1, 1]) {
      const arc = f => { const r = []; for (let i = 0; i <= 16; i++) { const g = i / 16 * Math.PI; r.push(f(a * Math.cos(g), e * (l + a * Math.sin(g)))); } out.push(r); };
      arc((u, v) => [u, 0, v]); arc((u, v) => [0, u, v]);
    }
  } else ring(0.03, 0.03, (u, v) => [u, v, 0]);
  return out.map(line => line.map(q => rotated(way.wxyz, q).map((v, i) => v + p[i])));
}
function scene() {
  const canvas = document.getElementById("scene"), [c, w, h] = paper(canvas);
  const path = D.tip.path, goals = D.tip.goals;
  if (!path.length) return;
  const near = [...path.map(r => r.slice(1)), ...goals, [0, 0, 0]];
  const low = [0, 1, 2].map(i => Math.min(...near.map(p => p[i])) - 0.35), high = [0, 1, 2].map(i => Math.max(...near.map(p => p[i])) + 0.35);
  for (const way of D.ways) for (const line of wires(way)) near.push(...line.filter(p => p.every((v, i) => v > low[i] && v < high[i])));
  const lo = [0, 1, 2].map(i => Math.min(...near.map(p => p[i]))), hi = [0, 1, 2].map(i => Math.max(...near.map(p => p[i])));
  const mid = lo.map((v, i) => (v + hi[i]) / 2), cy = Math.cos(eye.yaw), sy = Math.sin(eye.yaw), cp = Math.cos(eye.pitch), sp = Math.sin(eye.pitch);
  const flat = p => { const x = p[0] - mid[0], y = p[1] - mid[1], z = p[2] - mid[2]; return [-x * sy + y * cy, -(x * cy + y * sy) * sp + z * cp]; };
  const all = near.map(flat), span = Math.max(...all.map(p => Math.abs(p[0]))) / (w / 2 - 30), rise = Math.max(...all.map(p => Math.abs(p[1]))) / (h / 2 - 24);
  const k = 1 / Math.max(span, rise, 1e-6);
  const P = p => { const [u, v] = flat(p); return [w / 2 + u * k, h / 2 - v * k]; };
  const stroke = (line, colour, width, alpha) => { c.strokeStyle = colour; c.lineWidth = width; c.globalAlpha = alpha; c.beginPath(); line.forEach((p, i) => { const [x, y] = P(p); i ? c.lineTo(x, y) : c.moveTo(x, y); }); c.stroke(); c.globalAlpha = 1; };
  const floor = Math.min(0, lo[2]);
  for (let g = -1; g <= 1.001; g += 0.25) { stroke([[g, -1, floor], [g, 1, floor]], css("--line"), 1, 1); stroke([[-1, g, floor], [1, g, floor]], css("--line"), 1, 1); }
  for (const [axis, colour] of [[[0.15, 0, 0], "#c9354a"], [[0, 0.15, 0], "#2a9d5c"], [[0, 0, 0.15], "#2f6fde"]]) stroke([[0, 0, 0], axis], colour, 2, 0.9);
  c.textAlign = "left"; c.textBaseline = "middle";
  for (const way of D.ways) {
    for (const line of wires(way)) stroke(line, css("--soft"), 1, 0.8);
    if (way.path.length > 1) stroke(way.path, "#e0702b", 1, 0.7);
    const [x, y] = P(way.path[way.path.length - 1]);
    if (way.type !== "plane" && x > 0 && x < w && y > 0 && y < h) { c.fillStyle = css("--soft"); c.fillText(way.name, x + 6, y); }
  }
  const segments = D.statuses.length ? D.statuses : [[view.a, view.b, "moving"]];
  let s = 0, from = 0;
  for (let i = 1; i < path.length; i++) {
    const t = path[i][0];
    if (t < view.a || t > view.b) continue;
    while (s < segments.length - 1 && segments[s][1] < t) s++;
    stroke([path[i - 1].slice(1), path[i].slice(1)], segments[s][0] <= t ? STATUS[segments[s][2]] || "#9aa7b6" : "#9aa7b6", 2, 1);
  }
  goals.forEach((g, i) => { const [x, y] = P(g); c.strokeStyle = css("--ink"); c.lineWidth = 1.5; c.beginPath(); c.arc(x, y, 5, 0, 7); c.stroke(); c.fillStyle = css("--ink"); if (goals.length < 30) c.fillText(String(i + 1), x + 8, y - 6); });
  if (cursor !== null) {
    let i = 0; while (i < path.length - 1 && path[i + 1][0] <= cursor) i++;
    const [x, y] = P(path[i].slice(1)); c.fillStyle = css("--ink"); c.beginPath(); c.arc(x, y, 4.5, 0, 7); c.fill();
  }
}

function chart(id, xs, rows, logX, logY, unitX) {
  const canvas = document.getElementById(id);
  if (!canvas || !xs || !xs.length) { if (canvas) canvas.closest("figure").remove(); return; }
  const [c, w, h] = paper(canvas), fx = logX ? Math.log10 : v => v, fy = logY ? v => Math.log10(Math.max(v, 1e-12)) : v => v;
  const values = rows.flatMap(r => r[1]).filter(v => v !== null && (!logY || v > 0));
  if (!values.length) { canvas.closest("figure").remove(); return; }
  let low = fy(Math.min(...values)), high = fy(Math.max(...values));
  if (logY) low = Math.max(low, high - 6); else low = Math.min(low, 0);
  if (high - low < 1e-12) high = low + 1;
  const a = fx(xs[0]), b = fx(xs[xs.length - 1]), PX = v => LEFT + (fx(v) - a) / (b - a || 1) * (w - LEFT - RIGHT), PY = v => h - BOTTOM - (fy(v) - low) / (high - low) * (h - TOP - BOTTOM);
  c.strokeStyle = css("--line"); c.fillStyle = css("--soft"); c.textAlign = "right"; c.textBaseline = "middle";
  for (const v of logY ? ticks(low, high, 4).filter(Number.isInteger) : ticks(low, high, 4)) { const y = h - BOTTOM - (v - low) / (high - low) * (h - TOP - BOTTOM); c.beginPath(); c.moveTo(LEFT, y); c.lineTo(w - RIGHT, y); c.stroke(); c.fillText(logY ? number(10 ** v) : number(v), LEFT - 5, y); }
  c.textAlign = "center"; c.textBaseline = "top";
  for (const v of logX ? ticks(a, b, 6).filter(Number.isInteger) : ticks(a, b, Math.max(2, w / 110))) c.fillText(number(logX ? 10 ** v : v) + (unitX || ""), LEFT + (v - a) / (b - a || 1) * (w - LEFT - RIGHT), h - BOTTOM + 5);
  rows.forEach(([name, ys, bars], k) => {
    c.strokeStyle = c.fillStyle = COLOURS[k % COLOURS.length]; c.lineWidth = 1.3; c.beginPath();
    xs.forEach((x, i) => { if (bars) { if (ys[i] > 0) c.fillRect(PX(x), PY(ys[i]), Math.max(1, (w - LEFT - RIGHT) / xs.length - 1), h - BOTTOM - PY(ys[i])); } else if (ys[i] !== null) { i ? c.lineTo(PX(x), PY(ys[i])) : c.moveTo(PX(x), PY(ys[i])); } });
    c.stroke();
    if (!bars && rows.length > 1) { c.textAlign = "left"; c.textBaseline = "top"; c.fillText(name, LEFT + 8 + (k % 2) * 150, TOP + 13 * (k >> 1)); }
  });
}
function histogram(id, data) {
  const us = data.edges.map(e => e * 1e6), counts = data.counts.slice(0, us.length);
  let a = counts.findIndex(n => n > 0), b = counts.length - 1;
  if (a < 0) { document.getElementById(id).closest("figure").remove(); return; }
  while (counts[b] === 0) b--;
  a = Math.max(0, a - 2); b = Math.min(us.length - 1, b + 2);
  chart(id, us.slice(a, b + 1), [["ticks", counts.slice(a, b + 1), true]], true, true);
}
function bus() {
  const names = Object.keys(D.bus);
  if (!names.length) { chart("bus", []); return; }
  chart("bus", D.bus[names[0]][0], names.map(n => [n, D.bus[n][1].map(v => v * 100)]), false, false, " s");
}
function still() {
  histogram("hist-lateness", D.histograms.lateness); histogram("hist-compute", D.histograms.compute);
  if (D.spectrum.f) chart("spectrum", D.spectrum.f, Object.entries(D.spectrum.rows), true, true); else chart("spectrum", []);
}

const plots = [];
function build() {
  const host = document.getElementById("plots"), groups = new Map();
  for (const spec of D.plots) {
    if (!groups.has(spec.group)) {
      const section = document.createElement("section"), title = document.createElement("h2"), grid = document.createElement("div");
      section.id = "group-" + spec.group.toLowerCase(); section.dataset.name = spec.group; title.textContent = spec.group;
      grid.className = "grid" + (D.plots.filter(p => p.group === spec.group).length > 5 ? " many" : "");
      section.append(title, grid); host.append(section); groups.set(spec.group, grid);
    }
    plots.push(new Plot(spec, groups.get(spec.group)));
  }
  const seen = new IntersectionObserver(entries => { for (const e of entries) { const p = plots.find(q => q.canvas === e.target); p.visible = e.isIntersecting; if (p.visible) p.draw(); } }, { rootMargin: "200px" });
  for (const p of plots) seen.observe(p.canvas);
  const nav = document.getElementById("nav");
  for (const s of document.querySelectorAll("section")) { const a = document.createElement("a"); a.href = "#" + s.id; a.textContent = s.dataset.name; nav.append(a); }
  document.getElementById("reset").addEventListener("click", () => zoom(T0, T0 + END));
  for (const row of document.querySelectorAll("tr[data-t]")) row.addEventListener("click", () => {
    const t = +row.dataset.t, half = Math.min(END / 2, Math.max(0.5, END / 40));
    cursor = t; zoom(Math.max(T0, t - half), Math.min(T0 + END, t + half)); document.getElementById("overview").scrollIntoView({ behavior: "smooth" });
  });
  const box = document.getElementById("scene");
  let held = null;
  box.addEventListener("pointerdown", e => { held = [e.clientX, e.clientY, eye.yaw, eye.pitch]; box.setPointerCapture(e.pointerId); });
  box.addEventListener("pointermove", e => { if (!held) return; eye.yaw = held[2] - (e.clientX - held[0]) * 0.008; eye.pitch = Math.max(-1.57, Math.min(1.57, held[3] + (e.clientY - held[1]) * 0.008)); later(); });
  box.addEventListener("pointerup", () => { held = null; });
  for (const b of document.querySelectorAll("[data-view]")) b.addEventListener("click", () => { [eye.yaw, eye.pitch] = VIEWS[b.dataset.view]; later(); });
  drags(document.getElementById("timeline"));
  window.addEventListener("resize", () => { later(); still(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { later(); still(); });
}

unpack().then(() => { build(); keys(); still(); redraw(); document.body.dataset.ready = "1"; });
window.report = { view, series, plots, cursorAt: t => { cursor = t; redraw(); } };
