// One panel: axes with ticks, and what is drawn into them. Widths are those of the page, so letters keep their size.
function ticks(low, high, most) {
  const span = high - low || 1, raw = span / most, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((f) => f * power).find((s) => span / s <= most + 1e-9);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(i * step);
  return found;
}

function plot(node, { height, x, y, caption, xlabel = "", ylabel = "", names = null, left = null, right = 10, top = 8, columns = null, xticks = true, label }) {
  const width = Math.max(280, node.clientWidth || 600);
  left = left ?? (names ? 6.7 * Math.min(34, Math.max(...names.map((n) => n.length), 4)) + 12 : 52);
  left = Math.min(left, 0.46 * width);
  const bottom = xticks ? (xlabel ? 34 : 20) : 6, w = width - left - right, h = height - top - bottom;
  const X = (v) => left + w * (v - x[0]) / (x[1] - x[0] || 1);
  const Y = (v) => names ? top + h * (v + 0.5) / names.length : top + h * (1 - (v - y[0]) / (y[1] - y[0] || 1));
  const id = `clip${++plot.count}`;
  const root = sv("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label || caption || "" },
    sv("clipPath", { id }, sv("rect", { x: left, y: top - 2, width: w, height: h + 4 })));
  const under = sv("g", { "clip-path": `url(#${id})` }), inside = sv("g", { "clip-path": `url(#${id})` }), over = sv("g");
  root.append(under);
  if (names) {
    const most = Math.floor((left - 8) / 6.7); // letters; what is cut is the middle, since names differ at their ends
    names.forEach((name, i) => root.append(sv("text", { x: left - 6, y: Y(i) + 3.5, "text-anchor": "end" },
      name.length > most ? sv("title", null, name) : null, name.length > most ? `${name.slice(0, Math.ceil(most / 2) - 1)}\u2026${name.slice(-Math.floor(most / 2))}` : name)));
  } else {
    for (const v of ticks(y[0], y[1], Math.max(2, Math.floor(h / (h > 200 ? 48 : 26))))) {
      root.append(sv("path", { class: "grid", d: `M${left} ${Y(v)}H${left + w}` }),
        sv("text", { class: "quiet", x: left - 6, y: Y(v) + 3.5, "text-anchor": "end" }, short(v, 4)));
    }
  }
  if (columns) columns.forEach((name, j) => root.append(sv("text", { x: X(j), y: top + h + 15, "text-anchor": "middle" }, name)));
  if (xticks && !columns) {
    for (const v of ticks(x[0], x[1], Math.max(2, Math.floor(w / 70)))) {
      root.append(sv("path", { class: "grid", d: `M${X(v)} ${top}V${top + h}` }), sv("text", { class: "quiet", x: X(v), y: top + h + 14, "text-anchor": "middle" }, short(v, 4)));
    }
    if (xlabel) root.append(sv("text", { x: left + w / 2, y: height - 4, "text-anchor": "middle" }, xlabel));
  }
  root.append(sv("path", { class: "axis", d: `M${left} ${top}V${top + h}H${left + w}` }), inside, over);
  const value = el("output");
  node.replaceChildren(el("figcaption", null, el("span", null, el("b", null, caption), ylabel ? ` [${ylabel}]` : ""), value), root);
  return { root, under, inside, over, X, Y, left, top, w, h, width, height, value };
}
plot.count = 0;

// A path through points; a gap where there is no value, and nothing far outside the panel.
function path(panel, xs, ys) {
  const far = (v) => Math.max(-1e5, Math.min(1e5, v));
  let d = "", pen = "M";
  for (let i = 0; i < ys.length; i++) {
    if (ys[i] === null || Number.isNaN(ys[i])) { pen = "M"; continue; }
    d += `${pen}${panel.X(xs[i]).toFixed(1)} ${far(panel.Y(ys[i])).toFixed(1)}`;
    pen = "L";
  }
  return d;
}
function band(panel, xs, low, high) { // closed between two lines, in pieces where values are missing
  let d = "", from = 0;
  const ok = (i) => low[i] !== null && high[i] !== null && !Number.isNaN(low[i]) && !Number.isNaN(high[i]);
  while (from < xs.length) {
    if (!ok(from)) { from++; continue; }
    let to = from;
    while (to < xs.length && ok(to)) to++;
    const back = (a) => Array.from(a.slice(from, to)).reverse();
    d += path(panel, xs.slice(from, to), high.slice(from, to)) + path(panel, back(xs), back(low)).replace(/^M/, "L") + "Z";
    from = to;
  }
  return d;
}
function steps(xs, ys) { // a step function's corners
  const X = [], Y = [];
  xs.forEach((x, i) => { if (i) { X.push(x); Y.push(ys[i - 1]); } X.push(x); Y.push(ys[i]); });
  return [X, Y];
}
