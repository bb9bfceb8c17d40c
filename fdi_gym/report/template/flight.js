// A flight to look at: what is true, what a method says of it, and what the sensors say.
async function unpack(block, dt, samples) {
  const found = new Map();
  if (!block.packed) return found;
  const bytes = Uint8Array.from(atob(block.packed), (c) => c.charCodeAt(0));
  const plain = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  const view = new DataView(plain);
  let place = 0;
  for (const [kind, name, unit, low, step, count, scale] of block.heads) {
    const values = new Float64Array(count), times = new Float64Array(count);
    for (let i = 0; i < count; i++, place += 2) {
      const v = view.getUint16(place, true);
      values[i] = v === 65535 ? NaN : low + step * v;
      times[i] = (samples - 1) * dt * (count > 1 ? i / (count - 1) : 0);
    }
    if (!found.has(kind)) found.set(kind, []);
    found.get(kind).push({ name, unit, values, times, scale });
  }
  return found;
}

function range(lines, limits = [], least = 0) { // of what is drawn, with some air; a few wild points don't flatten the rest
  const all = lines.flatMap((v) => Array.from(v)).filter(Number.isFinite).sort((a, b) => a - b);
  if (!all.length) return [0, 1];
  const q = (s) => all[Math.min(all.length - 1, Math.floor(s * all.length))];
  const [a, b] = [q(0.005), q(0.995)], reach = 0.6 * (b - a);
  let low = Math.max(all[0], a - reach), high = Math.min(all[all.length - 1], b + reach);
  for (const v of limits) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
  if (high - low < least) [low, high] = [(low + high - least) / 2, (low + high + least) / 2]; // rounding errors stay small
  const air = 0.06 * (high - low) || 0.5 * Math.abs(high) || 0.5;
  return [low - air, high + air];
}

function flight() {
  const { flights, methods, dt, deviations } = data.flown;
  if (!flights.length || !methods.length) { at("flight-facts").textContent = "This report has no flights to look at."; return () => {}; }
  const state = { i: 0, name: methods[0], k: 0 };
  let panels = [], shown = null;
  const plural = (labels) => labels.length ? labels.join(", ") : data.labels[0];
  const faultsOf = (f) => [...new Set(f.label.map(([, , v]) => v).filter((v) => v > 0))].map((v) => data.labels[v]);
  at("flight-controls").append(
    choice("Flight", flights.map((f, i) => [String(i), `${f.number}: ${plural(faultsOf(f))}`]), "0", (value) => { state.i = Number(value); load(); }),
    choice("Method", methods.map((name) => [name, byName.has(name) ? starred(byName.get(name)) : name]), state.name, (value) => { state.name = value; load(); }));
  const range_ = el("input", { type: "range", min: 0, value: 0, "aria-label": "Time of the cursor", oninput: () => { state.k = Number(range_.value); cursor(); } });
  const time = el("output");
  at("cursor-controls").append(el("label", null, "Time"), range_, time);
  const truthKinds = [[0, "shade", "a fault acts"], [0, "truth", "truth"]];

  async function load() {
    const f = flights[state.i], said = f.said[state.name];
    shown = { f, said, own: await unpack(f.lines, dt, f.samples), its: await unpack(said.lines, dt, f.samples) };
    range_.max = f.samples - 1;
    state.k = Math.min(state.k, f.samples - 1) || Math.floor((f.samples - 1) / 2);
    range_.value = state.k;
    at("flight-facts").textContent = `Flight ${f.number}, seed ${f.seed}${f.healthy ? ", without its faults" : ""}: ${f.samples - 1} samples of ${dt} s. ` +
      `What is true: ${f.label.map(([a, , v]) => `${data.labels[v]} from ${short(Math.max(a - 1, 0) * dt, 4)} s`).join(", ")}. ` +
      `Lines are drawn with ${Math.min(data.flown.points, f.samples)} points that keep extremes; labels and alarms are whole.`;
    draw();
  }

  function panel(parent, options, values) { // with the shade of faults, and a line for the cursor
    const node = el("figure");
    parent.append(node);
    const end = (shown.f.samples - 1) * dt;
    const p = plot(node, { x: [0, end], left: 64, ...options });
    for (const [a, b, v] of shown.f.label) {
      if (v > 0) p.under.append(sv("rect", { class: "shade", x: p.X(Math.max(a - 1, 0) * dt), y: p.top, width: Math.max(0, p.X((b - 1) * dt) - p.X(Math.max(a - 1, 0) * dt)), height: p.h }));
    }
    p.cursor = sv("path", { class: "cursor" });
    p.over.append(p.cursor);
    p.say = values;
    panels.push(p);
    return p;
  }
  const valueAt = (line, t) => { // of the nearest point
    const n = line.values.length;
    return line.values[Math.max(0, Math.min(n - 1, Math.round(t / (line.times[n - 1] || 1) * (n - 1))))];
  };
  const runAt = (runs, k) => (runs.find(([a, b]) => k >= a && k < b) || runs[runs.length - 1])[2];
  const box = (title, many) => {
    const inner = el("div", { class: many ? "panels many" : "panels" });
    at("panels").append(el("details", { open: true }, el("summary", null, title), inner));
    return inner;
  };

  function draw() {
    if (!shown) return;
    const { f, said, own, its } = shown;
    panels = [];
    at("panels").replaceChildren();
    const truth = own.get("truth") || [], estimates = its.get("estimate") || [], spreads = its.get("deviation");
    at("flight-legend").replaceChildren(...legend(...truthKinds, [1, "block", `declared by ${state.name}`], ...(its.has("probability") ? [[0, "heat", "probability of the label"]] : []),
      ...(estimates.length ? [[0, "line", "estimate"]] : []), ...(spreads ? [[0, "band", `within ${deviations} stated deviations`]] : []), [0, "limit", "threshold, or 1.96 deviations of the sensor noise"]));
    labels(box("Labels", false));
    if (truth.length) {
      const into = box(estimates.length ? "Fault parameters: truth and estimate" : "Fault parameters: the truth (this method estimates none)", true);
      truth.forEach((line, j) => entry(into, line, estimates[j], spreads && spreads[j]));
    }
    if (its.has("residual")) {
      const into = box("Residuals: sensors less what they would say at the estimated state", true);
      its.get("residual").forEach((line, j) => curve(into, [line], line.name, line.unit, [1.96 * said.sigma[j], -1.96 * said.sigma[j]]));
    }
    if (its.has("signal")) signals(box("Signals of the method", true), its.get("signal"));
    for (const [kind, title] of [["sensor", "Sensors"], ["command", "Commands"], ["known", "What else is known"]]) {
      if (own.has(kind)) { const into = box(title, true); own.get(kind).forEach((line) => curve(into, [line], line.name, line.unit, [])); }
    }
    cursor();
  }

  function labels(into) {
    const { f, said, its } = shown;
    const chances = its.get("probability") || [];
    const declared = said.label.map(([a, b, both]) => [a, b, (both >> 1) - 1, both & 1]);
    const seen = new Set([0, ...f.label.map(([, , v]) => v), ...declared.map(([, , v]) => v)]);
    chances.forEach((line, v) => { if (line.values.some((p) => p >= 0.05)) seen.add(v); });
    const used = [...seen].filter((v) => v >= 0).sort((a, b) => a - b), lost = seen.has(-1);
    const names = [...used.map((v) => data.labels[v]), ...(lost ? ["(lost)"] : []), "alarm"];
    const row = (v) => v < 0 ? used.length : used.indexOf(v);
    const wide = Math.min(6.7 * Math.max(...names.map((n) => n.length)) + 14, 260);
    const p = panel(into, { height: 34 + 22 * names.length, names, left: wide, caption: "Label", label: "True and declared labels over time", xlabel: "time [s]" }, (t, k) => {
      const both = runAt(said.label, k), v = (both >> 1) - 1;
      const chance = chances[v] ? ` (${percent(valueAt(chances[v], t))} %)` : "";
      return `true ${data.labels[runAt(f.label, k)]}; declared ${v < 0 ? "(lost)" : data.labels[v]}${chance}`;
    });
    const end = f.samples - 1, step = p.h / names.length;
    const bar = (a, b, y, height, attributes) => sv("rect", { x: p.X(Math.min(a, end) * dt), y: y - height / 2, width: Math.max(0.8, p.X(Math.min(b, end) * dt) - p.X(Math.min(a, end) * dt)), height, ...attributes });
    used.forEach((v, i) => { // probabilities in twenty shades, equal neighbours as one
      const line = chances[v];
      if (!line) return;
      const shades = Array.from(line.values, (c) => Math.round(20 * c) / 20), width = end / line.values.length;
      for (let a = 0, b; a < shades.length; a = b) {
        for (b = a + 1; b < shades.length && shades[b] === shades[a]; b++);
        if (shades[a] > 0) p.inside.append(bar(a * width, b * width, p.Y(i), 0.86 * step, { class: "heat", opacity: (0.5 * shades[a]).toFixed(2) }));
      }
    });
    for (const [a, b, v, alarm] of declared) {
      p.inside.append(bar(Math.max(a - 1, 0), b - 1, p.Y(row(v)), 9, { class: "block" }));
      if (alarm) p.inside.append(bar(Math.max(a - 1, 0), b - 1, p.Y(names.length - 1), 9, { class: "block" }));
    }
    const xs = [], ys = []; // the truth above what is declared
    for (const [a, b, v] of f.label) { xs.push(Math.max(a - 1, 0) * dt, (b - 1) * dt); ys.push(row(v), row(v)); }
    p.inside.append(sv("path", { class: "truth", d: path(p, xs, ys) }));
  }

  function entry(into, line, estimate, spread) {
    const lines = [line.values, ...(estimate ? [estimate.values] : [])];
    const p = panel(into, { height: 130, y: range(lines, [], 0.2 * line.scale), caption: line.name, ylabel: line.unit }, (t) =>
      `true ${short(valueAt(line, t))}` + (estimate ? `, estimate ${short(valueAt(estimate, t))}${spread ? ` \u00b1 ${short(deviations * valueAt(spread, t), 2)}` : ""}` : ""));
    if (estimate && spread) {
      const low = Array.from(estimate.values, (v, i) => v - deviations * spread.values[i]), high = Array.from(estimate.values, (v, i) => v + deviations * spread.values[i]);
      p.inside.append(sv("path", { class: "band f0", d: band(p, estimate.times, low, high) }));
    }
    if (estimate) p.inside.append(sv("path", { class: "line l0", d: path(p, estimate.times, estimate.values) }));
    p.inside.append(sv("path", { class: "truth", d: path(p, line.times, line.values) }));
  }

  function curve(into, lines, name, unit, limits, bounds = []) {
    const p = panel(into, { height: 120, y: range([...lines.map((l) => l.values), ...bounds.map((l) => l.values)], limits, 1e-6 * (lines[0].scale || 0)), caption: name, ylabel: unit }, (t) => lines.map((l) => short(valueAt(l, t))).join(", "));
    lines.forEach((line, i) => p.inside.append(sv("path", { class: `line thin l${i % 14}`, d: path(p, line.times, line.values) })));
    for (const v of limits) p.inside.append(sv("path", { class: "limit", d: `M${p.left} ${p.Y(v)}H${p.left + p.w}` }));
    for (const line of bounds) {
      p.inside.append(sv("path", { class: "limit", d: path(p, line.times, line.values) }));
      p.inside.append(sv("path", { class: "limit", d: path(p, line.times, Array.from(line.values, (v) => -v)) }));
    }
  }

  function signals(into, all) { // a residual goes with the threshold of its own component
    const groups = new Map();
    for (const line of all) { if (!groups.has(line.name)) groups.set(line.name, []); groups.get(line.name).push(line); }
    const residual = groups.get("residual"), threshold = groups.get("threshold");
    if (residual && threshold && residual.length === threshold.length) {
      residual.forEach((line, j) => curve(into, [line], `residual ${line.unit}`, "", [], [threshold[j]]));
      groups.delete("residual");
      groups.delete("threshold");
    }
    for (const [name, lines] of groups) curve(into, lines, name, "", []);
  }

  function cursor() {
    const t = state.k * dt;
    time.textContent = `${short(t, 5)} s`;
    for (const p of panels) {
      p.cursor.setAttribute("d", `M${p.X(t)} ${p.top}V${p.top + p.h}`);
      p.value.textContent = p.say(t, state.k);
    }
  }
  load();
  return draw;
}
