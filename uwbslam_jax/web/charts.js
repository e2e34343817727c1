// Charts of a finished run: SVG over time; a click moves the run to that time.
const pad = { left: 46, right: 10, top: 8, bottom: 20 };
function limits(values, zero) {
  let lo = zero ? 0 : Infinity, hi = zero ? 0 : -Infinity;
  for (const v of values) if (v !== null) { lo = Math.min(lo, v); hi = Math.max(hi, v); }
  if (!(hi > lo)) return Number.isFinite(lo) ? [lo - 0.5, lo + 0.5] : [0, 1];
  return [lo < 0 || !zero ? lo - (hi - lo) * 0.05 : lo, hi + (hi - lo) * 0.05];
}
// Axes around a body made by (x, y) -> svg text; whole: no ticks between whole numbers.
function frame(box, height, [lo, hi], body, name, whole = false) {
  const width = Math.max(box.clientWidth, 200);
  const x = (t) => pad.left + t / duration * (width - pad.left - pad.right);
  const y = (v) => height - pad.bottom - (v - lo) / (hi - lo) * (height - pad.top - pad.bottom);
  let axes = "";
  const ystep = Math.max(niceStep((hi - lo) / 4), whole ? 1 : 0), digits = clamp(-Math.floor(Math.log10(ystep) + 1e-9), 0, 6);
  for (let v = Math.ceil(lo / ystep) * ystep; v <= hi + ystep * 1e-6; v += ystep)
    axes += `<line class="grid" x1="${pad.left}" x2="${width - pad.right}" y1="${y(v)}" y2="${y(v)}"/>` +
      `<text x="${pad.left - 6}" y="${y(v) + 4}" text-anchor="end">${(Math.abs(v) < ystep * 1e-6 ? 0 : v).toFixed(digits)}</text>`;
  const tstep = niceStep(duration / (width / 90));
  for (let t = 0; t <= duration * 1.0001; t += tstep)
    axes += `<text x="${x(t)}" y="${height - 4}" text-anchor="middle">${+t.toPrecision(6)}${t === 0 ? " s" : ""}</text>`;
  box.innerHTML = `<svg width="${width}" height="${height}" role="img" aria-label="${esc(name)}">${axes}${body(x, y)}` +
    `<line class="cursor" y1="${pad.top}" y2="${height - pad.bottom}"/></svg>`;
  const cursor = box.querySelector(".cursor");
  box.showTime = () => { cursor.setAttribute("x1", x(now)); cursor.setAttribute("x2", x(now)); };
  box.timeAt = (e) => (e.clientX - box.getBoundingClientRect().left - pad.left) / (width - pad.left - pad.right) * duration;
  box.showTime();
}
function lineChart(box, series) {
  const { t, v, steps } = series;
  frame(box, 130, limits(v, true), (x, y) => {
    let d = "", pen = false, before = 0;
    for (let k = 0; k < t.length; k++) {
      if (v[k] === null) { pen = false; continue; }
      const X = x(t[k]).toFixed(1), Y = y(v[k]).toFixed(1);
      d += !pen ? `M${X} ${Y}` : steps ? `L${X} ${before}L${X} ${Y}` : `L${X} ${Y}`;
      pen = true; before = Y;
    }
    return `<path class="series" d="${d}"/>`;
  }, series.name, steps);
}
function residualChart(box) {
  const r = data.residuals, chosen = $("pair").value, bound = r.bound;
  frame(box, 240, [-bound, bound], (x, y) => {
    const d = ["", ""];
    for (let k = 0; k < r.t.length; k++) {
      if (r.v[k] === null || (chosen !== "" && +chosen !== r.pair[k])) continue;
      d[r.kind[r.pair[k]]] += `M${x(r.t[k]).toFixed(1)} ${y(clamp(r.v[k], -bound, bound)).toFixed(1)}h0`;
    }
    return `<path class="dots first" d="${d[0]}"/><path class="dots second" d="${d[1]}"/>`;
  }, "Range residuals over time");
}
function listenToChart(box, value) {
  const show = (e) => {
    const t = box.timeAt(e);
    if (value && t >= 0 && t <= duration) value(t);
  };
  box.addEventListener("pointermove", show);
  box.addEventListener("click", (e) => { stop(); setTime(box.timeAt(e)); });
  onTime.push(() => box.showTime && box.showTime());
}
const charts = [];
for (const box of document.querySelectorAll("[data-chart]")) {
  const series = data.diagnostics[+box.dataset.chart], out = box.parentElement.querySelector("output");
  const read = (t) => {
    const k = lastBefore(series.t, t), v = k < 0 ? null : series.v[k];
    out.textContent = v === null ? "" : `${+v.toPrecision(4)} ${series.unit} at ${t.toFixed(1)} s`;
  };
  charts.push(() => lineChart(box, series));
  listenToChart(box, read);
}
if ($("residuals")) {
  charts.push(() => residualChart($("residuals")));
  listenToChart($("residuals"), null);
  $("pair").onchange = () => residualChart($("residuals"));
}

