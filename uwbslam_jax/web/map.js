// Map, track, robot and beacons at one time of a run: of a finished one, or of one that live.js lets grow. Reads the JSON
// that is embedded in the page (report_data.page_data) and the colours that page.css names. Angles in rad, lengths in m.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
let { track, beacons, duration } = data;
const clamp = (v, lo, hi) => Math.min(hi, Math.max(lo, v));
const esc = (s) => String(s).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
let css = {};
let ramp = [];
let now = duration;
const onTime = []; // called whenever the time shown changes

function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["ink", "muted", "line", "card", "accent", "second", "free", "occupied", "unknown", "scan", "static",
    "moving", "silent", "dropped", "relative", "fits", "off", "far-off", "nlos"]) css[name] = style.getPropertyValue(`--${name}`).trim();
  ramp = style.getPropertyValue("--ramp").split(",").map((c) => rgb(c.trim()));
}
function rgb(hex) { return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)); }
function mix(a, b, f) { return a.map((v, k) => Math.round(v + (b[k] - v) * f)); }
function rampColour(f) {
  const x = clamp(f, 0, 1) * (ramp.length - 1), k = Math.min(Math.floor(x), ramp.length - 2);
  return `rgb(${mix(ramp[k], ramp[k + 1], x - k)})`;
}
function lastBefore(times, t) { // index of the last entry at or before t, -1 where there is none
  let lo = 0, hi = times.length;
  while (lo < hi) { const mid = (lo + hi) >> 1; if (times[mid] <= t) lo = mid + 1; else hi = mid; }
  return lo - 1;
}
function setTime(t) {
  now = clamp(t, 0, duration);
  $("time").value = now;
  $("clock").textContent = `${now.toFixed(1)} s`;
  showPose(lastBefore(track.t, now));
  for (const show of onTime) show();
}

function showPose(k) {
  const turn = k < 0 || track.x[k] === null ? null : (track.yaw[k] || 0) * 180 / Math.PI;
  const spread = turn === null || track.xx[k] === null ? null : Math.sqrt(Math.max(track.xx[k] + track.yy[k], 0));
  $("pose").textContent = turn === null ? "no pose" : `x ${track.x[k].toFixed(3)} m, y ${track.y[k].toFixed(3)} m, heading ` +
    `${(turn - 360 * Math.round(turn / 360)).toFixed(1)}°${spread === null ? "" : `, ± ${spread.toFixed(3)} m`}`;
}

// ---- the map: canvas in metres, y up --------------------------------------------------------------------------
const canvas = $("map"), ctx = canvas.getContext("2d");
const view = { x: 0, y: 0, scale: 50 }; // centre [m], pixels a metre
const layers = { track: true, beacons: true, links: true, scan: true, grid: true };
let tiles = null, grey = null, queued = false, touched = false; // touched: the view was chosen by hand
const px = (x) => (x - view.x) * view.scale + canvas.clientWidth / 2;
const py = (y) => (view.y - y) * view.scale + canvas.clientHeight / 2;
function draw() {
  if (!queued) { queued = true; requestAnimationFrame(() => { queued = false; drawMap(); }); }
}

function showMap() { // data.map has changed
  if (!data.map) { tiles = grey = null; draw(); return; }
  const image = new Image();
  image.onload = () => {
    const scratch = document.createElement("canvas");
    scratch.width = image.width; scratch.height = image.height;
    const context = scratch.getContext("2d");
    context.drawImage(image, 0, 0);
    grey = context.getImageData(0, 0, image.width, image.height);
    colourMap(); draw();
  };
  image.src = data.map.png;
}
function colourMap() { // grey level 255 (1 - p) -> the theme's colours; never observed stays transparent
  if (!grey) return;
  const image = new ImageData(new Uint8ClampedArray(grey.data), grey.width, grey.height);
  const [free, unknown, occupied] = [rgb(css.free), rgb(css.unknown), rgb(css.occupied)];
  const table = Array.from({ length: 256 }, (_, g) =>
    g > 127 ? mix(unknown, free, (g - 127) / 128) : mix(unknown, occupied, (127 - g) / 127));
  for (let k = 0; k < image.data.length; k += 4) {
    const colour = table[image.data[k]];
    image.data[k] = colour[0]; image.data[k + 1] = colour[1]; image.data[k + 2] = colour[2];
  }
  tiles = document.createElement("canvas");
  tiles.width = grey.width; tiles.height = grey.height;
  tiles.getContext("2d").putImageData(image, 0, 0);
}

function fit() {
  touched = false;
  $("follow").checked = false;
  const [x0, y0, x1, y1] = data.extent;
  view.x = (x0 + x1) / 2; view.y = (y0 + y1) / 2;
  view.scale = 0.94 * Math.min(canvas.clientWidth / (x1 - x0), canvas.clientHeight / (y1 - y0));
  draw();
}
function pan(x, y) {
  view.x += x; view.y += y;
  touched = true; $("follow").checked = false;
  draw();
}
function zoom(factor, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) { // about a pixel that stays put
  const scale = clamp(view.scale * factor, 0.2, 20000), dx = x - canvas.clientWidth / 2, dy = y - canvas.clientHeight / 2;
  view.x += dx / view.scale - dx / scale;
  view.y -= dy / view.scale - dy / scale;
  view.scale = scale;
  touched = true;
  draw();
}

function niceStep(rough) {
  const base = 10 ** Math.floor(Math.log10(rough));
  return base * [1, 2, 5, 10].find((k) => base * k >= rough * 0.999);
}
function drawGrid(width, height) {
  const step = niceStep(70 / view.scale);
  ctx.strokeStyle = css.line; ctx.lineWidth = 1; ctx.globalAlpha = 0.6;
  ctx.beginPath();
  const left = view.x - width / 2 / view.scale, bottom = view.y - height / 2 / view.scale;
  for (let x = Math.ceil(left / step) * step; px(x) < width; x += step) { ctx.moveTo(px(x), 0); ctx.lineTo(px(x), height); }
  for (let y = Math.ceil(bottom / step) * step; py(y) > 0; y += step) { ctx.moveTo(0, py(y)); ctx.lineTo(width, py(y)); }
  ctx.stroke();
  ctx.globalAlpha = 1;
}
function drawTrack(end) {
  const width = clamp(view.scale * 0.04, 1.6, 5), bins = 64;
  ctx.lineJoin = ctx.lineCap = "round";
  const stroke = (from, to, colour, alpha, w) => {
    ctx.strokeStyle = colour; ctx.globalAlpha = alpha; ctx.lineWidth = w; ctx.beginPath();
    let pen = false;
    for (let k = from; k <= to; k++) {
      if (track.x[k] === null) { pen = false; continue; }
      if (pen) ctx.lineTo(px(track.x[k]), py(track.y[k])); else ctx.moveTo(px(track.x[k]), py(track.y[k]));
      pen = true;
    }
    ctx.stroke();
  };
  const n = track.t.length;
  if (end < n - 1) stroke(Math.max(end, 0), n - 1, css.muted, 0.35, 1.2);
  for (let b = 0; b < bins; b++) {
    const from = Math.floor(b * (n - 1) / bins), to = Math.min(Math.floor((b + 1) * (n - 1) / bins), end);
    if (to > from) stroke(from, to, rampColour(track.t[from] / duration), 1, width);
  }
  ctx.globalAlpha = 1;
}
function ellipse(x, y, cov, colour) { // 2 sigma of cov = [xx, xy, yy] in m^2
  const [a, b, c] = cov, mean = (a + c) / 2, spread = Math.hypot((a - c) / 2, b);
  ctx.beginPath();
  ctx.ellipse(px(x), py(y), 2 * view.scale * Math.sqrt(Math.max(mean + spread, 0)),
    2 * view.scale * Math.sqrt(Math.max(mean - spread, 0)), -Math.atan2(2 * b, a - c) / 2, 0, 2 * Math.PI);
  ctx.fillStyle = ctx.strokeStyle = colour; ctx.lineWidth = 1.5;
  ctx.globalAlpha = 0.18; ctx.fill(); ctx.globalAlpha = 0.9; ctx.stroke(); ctx.globalAlpha = 1;
}
function label(text, x, y, colour) {
  ctx.font = "600 13px system-ui, sans-serif"; ctx.textBaseline = "middle";
  ctx.lineWidth = 4; ctx.strokeStyle = css.card; ctx.lineJoin = "round";
  ctx.strokeText(text, x, y); ctx.fillStyle = colour; ctx.fillText(text, x, y);
}
function beaconAt(beacon, t) { // its last estimate at that time, null before it was placed
  const path = beacon.track;
  if (t >= duration || !path) return { x: beacon.x, y: beacon.y, cov: beacon.cov };
  const k = lastBefore(path.t, t);
  if (k < 0) return null;
  const v = (path.sigma[k] || 0) ** 2;
  return { x: path.x[k], y: path.y[k], cov: [v, 0, v] };
}
function drawBeacons() {
  for (const beacon of beacons) {
    const at = beaconAt(beacon, now);
    if (!at || at.x === null) continue;
    const colour = css[beacon.status] || css.accent, x = px(at.x), y = py(at.y);
    if (!at.cov.includes(null)) ellipse(at.x, at.y, at.cov, colour);
    ctx.beginPath(); ctx.moveTo(x, y - 8); ctx.lineTo(x + 7.5, y + 5.5); ctx.lineTo(x - 7.5, y + 5.5); ctx.closePath();
    ctx.fillStyle = colour; ctx.strokeStyle = css.card; ctx.lineWidth = 2; ctx.stroke(); ctx.fill();
    label(String(beacon.id), x + 12, y, css.ink);
  }
}
function linksAt(t) { // [node, node, residual or null where there is no line of sight] of a little more than the last second
  if (data.links) return t >= duration ? data.links : [];
  const r = data.residuals, seen = new Map();
  for (let k = lastBefore(r.t, t); k >= 0 && r.t[k] > t - 1.3; k--) if (!seen.has(r.pair[k])) seen.set(r.pair[k], r.v[k]);
  return [...seen].map(([pair, v]) => [...r.pairs[pair], v]);
}
function drawLinks(k) {
  if (k < 0) return;
  const places = new Map(beacons.map((b) => [b.id, beaconAt(b, now)]));
  const robot = { x: track.x[k], y: track.y[k] };
  for (const [a, b, residual] of linksAt(now)) {
    const [p, q] = [a, b].map((node) => places.has(node) ? places.get(node) : robot);
    if (!p || !q || p.x === null || q.x === null) continue;
    const size = Math.abs(residual);
    ctx.strokeStyle = residual === null ? css.nlos : size < 0.2 ? css.fits : size < 0.5 ? css.off : css["far-off"];
    ctx.setLineDash(residual === null ? [4, 4] : []);
    ctx.lineWidth = places.has(a) && places.has(b) ? 0.8 : 1.6; ctx.globalAlpha = 0.6;
    ctx.beginPath(); ctx.moveTo(px(p.x), py(p.y)); ctx.lineTo(px(q.x), py(q.y)); ctx.stroke();
  }
  ctx.setLineDash([]); ctx.globalAlpha = 1;
}
function drawRobot(k) {
  if (k < 0 || track.x[k] === null) return;
  const cov = [track.xx[k], track.xy[k], track.yy[k]];
  if (!cov.includes(null)) ellipse(track.x[k], track.y[k], cov, css.accent);
  ctx.save();
  ctx.translate(px(track.x[k]), py(track.y[k])); ctx.rotate(-(track.yaw[k] || 0));
  ctx.beginPath(); ctx.moveTo(14, 0); ctx.lineTo(-8, 8); ctx.lineTo(-4, 0); ctx.lineTo(-8, -8); ctx.closePath();
  ctx.lineWidth = 3; ctx.strokeStyle = css.card; ctx.stroke(); ctx.fillStyle = css.accent; ctx.fill();
  ctx.restore();
}
function drawScaleBar(width, height) {
  const length = niceStep(60 / view.scale), w = length * view.scale, text = length < 1 ? `${+(length * 100).toPrecision(3)} cm` : `${length} m`;
  ctx.strokeStyle = css.ink; ctx.lineWidth = 2; ctx.beginPath();
  ctx.moveTo(14, height - 20); ctx.lineTo(14, height - 14); ctx.lineTo(14 + w, height - 14); ctx.lineTo(14 + w, height - 20);
  ctx.stroke();
  label(text, 18, height - 28, css.ink);
}
function drawMap() {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const k = lastBefore(track.t, now);
  if ($("follow").checked && k >= 0 && track.x[k] !== null) { view.x = track.x[k]; view.y = track.y[k]; }
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.fillStyle = css.unknown; ctx.fillRect(0, 0, width, height);
  if (tiles && data.map) {
    const { origin, cell, rows, cols } = data.map;
    ctx.imageSmoothingEnabled = cell * view.scale < 1.5;
    ctx.drawImage(tiles, px(origin[0]), py(origin[1] + rows * cell), cols * cell * view.scale, rows * cell * view.scale);
  }
  if (layers.grid) drawGrid(width, height);
  if (layers.track) drawTrack(k);
  if (layers.scan && now >= duration) {
    ctx.fillStyle = css.scan;
    for (const [x, y] of data.scan) if (x !== null && y !== null) ctx.fillRect(px(x) - 1.2, py(y) - 1.2, 2.4, 2.4);
  }
  if (layers.links) drawLinks(k);
  if (layers.beacons) drawBeacons();
  drawRobot(k);
  drawScaleBar(width, height);
}

function showPointer(x, y) {
  const near = beacons.map((b) => [b, beaconAt(b, now)]) // the beacon under the pointer
    .find(([, at]) => at && at.x !== null && Math.hypot(px(at.x) - x, py(at.y) - y) < 16);
  const mx = view.x + (x - canvas.clientWidth / 2) / view.scale, my = view.y - (y - canvas.clientHeight / 2) / view.scale;
  $("where").textContent = near
    ? `beacon ${near[0].id} (${near[0].status}): ${near[1].x.toFixed(3)}, ${near[1].y.toFixed(3)} m`
    : `${mx.toFixed(2)}, ${my.toFixed(2)} m`;
}
function listenToMap() {
  const pointers = new Map();
  const at = (e) => { const box = canvas.getBoundingClientRect(); return [e.clientX - box.left, e.clientY - box.top]; };
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); pointers.set(e.pointerId, at(e)); });
  canvas.addEventListener("pointermove", (e) => {
    const before = pointers.get(e.pointerId), after = at(e);
    showPointer(...after);
    if (!before) return;
    if (pointers.size === 2) {
      const other = [...pointers.entries()].find(([id]) => id !== e.pointerId)[1];
      const gap = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
      zoom(gap(after) / gap(before), (after[0] + other[0]) / 2, (after[1] + other[1]) / 2);
    }
    pointers.set(e.pointerId, after);
    pan((before[0] - after[0]) / view.scale / pointers.size, (after[1] - before[1]) / view.scale / pointers.size);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => pointers.delete(e.pointerId));
  canvas.addEventListener("pointerleave", () => { $("where").textContent = ""; });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0015), ...at(e)); }, { passive: false });
  canvas.addEventListener("dblclick", fit);
  canvas.addEventListener("keydown", (e) => {
    const step = 60 / view.scale;
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (moves[e.key]) pan(...moves[e.key]); else if (e.key === "+") zoom(1.3); else if (e.key === "-") zoom(1 / 1.3);
    else if (e.key === "0") fit(); else if (e.key === "f" || e.key === "F") $("follow").click();
    else if (e.key === " ") $("play").click(); else return;
    e.preventDefault();
  });
  $("zoom-in").onclick = () => zoom(1.4);
  $("zoom-out").onclick = () => zoom(1 / 1.4);
  $("zoom-fit").onclick = fit;
  $("follow").onchange = draw;
  for (const name of Object.keys(layers)) $(`layer-${name}`).onchange = (e) => { layers[name] = e.target.checked; draw(); };
  $("time").addEventListener("input", (e) => { stop(); setTime(+e.target.value); });
  $("play").onclick = () => (playing ? stop() : play());
}
let playing = 0;
function stop() { cancelAnimationFrame(playing); playing = 0; $("play").textContent = "Play"; }
function play() { // the whole run in at most 30 s
  const speed = Math.max(1, duration / 30);
  let last = null;
  if (now >= duration) setTime(0);
  $("play").textContent = "Pause";
  const tick = (ms) => {
    setTime(now + (last === null ? 0 : (ms - last) / 1000 * speed));
    last = ms;
    if (now >= duration) stop(); else playing = requestAnimationFrame(tick);
  };
  playing = requestAnimationFrame(tick);
}

