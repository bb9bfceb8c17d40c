// How soon faults show (1 less Kaplan & Meier's curve), and which are found, by severity and by label.
const MOST = 6; // methods in one figure

function firstFew() {
  const honest = data.methods.filter((m) => !m.knows && m.family !== "floor");
  return [...honest.slice(0, 3), ...data.methods.filter((m) => m.ceiling).slice(0, 1)].map((m) => m.name);
}
function caption(id, text) { at(id).append(el("p", { class: "quiet" }, text)); }

let shown = firstFew(); // in all of these figures
function curves() {
  const draws = [delays(), faults()], draw = () => draws.forEach((one) => one());
  at("curve-controls").append(several("Methods", data.methods.map((m) => [m.name, starred(m)]), shown, MOST, (on) => { shown = on; draw(); }));
  draw();
  return draw;
}

function delays() {
  function one(id, title) {
    const curves = shown.map((name) => byName.get(name).delay[id]).filter((c) => c.x.length);
    const end = Math.max(...curves.map((c) => c.x[c.x.length - 1]), 1e-9);
    const panel = plot(at(id), { height: 300, x: [0, end], y: [0, 100], caption: title, xlabel: "time since the onset [s]", ylabel: "% of faults" });
    shown.forEach((name, i) => {
      const c = byName.get(name).delay[id];
      const as = (key) => steps(c.x, c[key].map((v) => v === null ? null : 100 * v));
      panel.inside.append(sv("path", { class: `band f${i}`, d: band(panel, as("low")[0], as("low")[1], as("high")[1]) }), sv("path", { class: `line l${i}`, d: path(panel, ...as("share")) }));
    });
    const n = shown.map((name) => `${name} ${byName.get(name).delay[id].count[0] || 0}`);
    caption(id, `Bands: 95 %. Faults n: ${n.join(", ")}.`);
  }
  function draw() {
    at("curve-legend").replaceChildren(...legend(...shown.map((name, i) => [i, "line", starred(byName.get(name))])));
    one("detection", "Detected: an alarm is on");
    one("isolation", "Isolated: the right label is declared");
  }
  return draw;
}

function faults() {
  let kind = "per_decision";
  at("fault-controls").append(choice("Right labels", [["per_decision", "per decision"], ["per_sample", "per sample"]], kind, (value) => { kind = value; draw(); }),
    el("span", { class: "quiet" }, "Methods: those chosen above."));
  const unit = () => kind === "per_sample" ? "samples" : "decisions";

  function severity() {
    const panel = plot(at("severity"), { height: 300, x: [-0.4, data.bands.length - 0.6], y: [0, 100], caption: "By severity of the fault", ylabel: "% right", columns: data.bands.map((band, j) => `${band} (n ${(shown.length && byName.get(shown[0]).severity[kind].count[j]) || 0})`) });
    shown.forEach((name, i) => {
      const c = byName.get(name).severity[kind], off = 0.05 * (i - (shown.length - 1) / 2);
      const xs = c.x.map((x) => x + off), here = (a) => a.map((v) => v === null ? null : 100 * v);
      panel.inside.append(sv("path", { class: `line l${i}`, d: path(panel, xs, here(c.share)) }));
      xs.forEach((x, j) => {
        if (c.share[j] === null) return;
        panel.inside.append(sv("path", { class: `line l${i} solid`, "stroke-dasharray": "none", d: `M${panel.X(x)} ${panel.Y(100 * c.low[j])}V${panel.Y(100 * c.high[j])}` }),
          sv("circle", { class: `dot f${i}`, cx: panel.X(x), cy: panel.Y(100 * c.share[j]), r: 4 }, sv("title", null, `${name}: ${percent(c.share[j])} [${percent(c.low[j])}, ${percent(c.high[j])}]`)));
      });
    });
    at("severity").append(el("p", { class: "quiet" }, `n ${unit()}. Bars: 95 %.`));
  }
  function recall() {
    const n = shown.length ? byName.get(shown[0]).recall[kind].count : [];
    const names = data.labels.map((label, j) => `${label} (${n[j] ?? 0})`), tall = 12 + 8 * shown.length;
    const panel = plot(at("recall"), { height: 60 + tall * names.length, x: [0, 100], names, caption: `By label (n ${unit()})`, xlabel: "share of right labels [%]", top: 10 });
    const step = panel.h / names.length, gap = Math.min(9, step / (shown.length + 1));
    data.labels.forEach((_, j) => { if (j % 2) panel.under.append(sv("rect", { class: "shade", x: panel.left, y: panel.Y(j) - step / 2, width: panel.w, height: step, opacity: .5 })); });
    shown.forEach((name, i) => {
      const c = byName.get(name).recall[kind];
      c.share.forEach((v, j) => {
        if (v === null) return;
        const y = panel.Y(j) + gap * (i - (shown.length - 1) / 2);
        panel.inside.append(sv("path", { class: `line l${i}`, d: `M${panel.X(100 * c.low[j])} ${y}H${panel.X(100 * c.high[j])}` }),
          sv("circle", { class: `dot f${i}`, cx: panel.X(100 * v), cy: y, r: 3.5 }, sv("title", null, `${name}: ${percent(v)} [${percent(c.low[j])}, ${percent(c.high[j])}]`)));
      });
    });
  }
  function draw() {
    at("fault-legend").replaceChildren(...legend(...shown.map((name, i) => [i, "line", starred(byName.get(name))])));
    severity();
    recall();
  }
  return draw;
}
