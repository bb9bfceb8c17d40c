// Scores with their intervals, what joins those that cannot be told apart, and differences from one of them.
function comparison() {
  const state = { kind: "per_sample", one: null };
  const kinds = [["per_sample", "per sample"], ["per_decision", "per decision"]];
  const controls = at("comparison-controls");

  function ranking() {
    const { names, cliques } = data.compared[state.kind];
    const frame = data.methods.filter((m) => m.family === "floor" || m.ceiling);
    const panel = plot(at("ranking"), { height: 58 + 19 * Math.max(names.length, 1), x: [0, 100], names: names.length ? names : ["none"], right: 12 + 6 * cliques.length, top: 14,
      caption: "Balanced accuracy with 95 % interval", xlabel: `${state.kind.replace("_", " ")} [%]` });
    const lines = [];
    for (const m of frame) {
      const v = m.score[state.kind][0];
      if (v === null) continue;
      panel.inside.append(sv("path", { class: "frame-line", d: `M${panel.X(100 * v)} ${panel.top}V${panel.top + panel.h}` }));
      lines.push(`${starred(m)} ${percent(v)}`);
    }
    names.forEach((name, i) => {
      const [v, low, high] = byName.get(name).score[state.kind];
      const other = state.one && state.one !== name && !like(name) ? " unlike" : "";
      panel.inside.append(sv("path", { class: `line l0${other}`, d: `M${panel.X(100 * low)} ${panel.Y(i)}H${panel.X(100 * high)}` }),
        sv("circle", { class: `dot f0${other}`, cx: panel.X(100 * v), cy: panel.Y(i), r: 4.5 }, sv("title", null, `${name}: ${percent(v)} [${percent(low)}, ${percent(high)}]`)));
    });
    cliques.forEach(([a, b], i) => {
      const x = panel.left + panel.w + 9 + 6 * i;
      panel.over.append(sv("path", { class: "clique", d: `M${x} ${panel.Y(a) - 5}V${panel.Y(b) + 5}` }));
    });
    at("ranking").append(el("p", { class: "quiet" }, `Bars at the right join methods no two of which can be told apart (all pairs, Holm). ${data.suite.flights} flights.` + (lines.length ? ` Dotted: ${lines.join(", ")}.` : "")));
  }

  function like(name) { // cannot be told from the chosen one
    const { names, p } = data.compared[state.kind];
    return p[names.indexOf(state.one)][names.indexOf(name)] >= 0.05;
  }

  function differences() {
    const { names, gap, reach } = data.compared[state.kind];
    const i = names.indexOf(state.one), others = names.filter((name) => name !== state.one);
    if (i < 0 || !others.length) { at("differences").replaceChildren(); return; }
    const values = others.map((name) => { const j = names.indexOf(name); return [100 * gap[j][i], 100 * reach[j][i]]; });
    const far = Math.max(1, ...values.map(([g, r]) => Math.abs(g) + r)) * 1.05;
    const panel = plot(at("differences"), { height: 58 + 19 * others.length, x: [-far, far], names: others, top: 14,
      caption: `Less ${state.one}: paired difference with 95 % interval`, xlabel: "difference [percentage points]" });
    panel.inside.append(sv("path", { class: "zero", d: `M${panel.X(0)} ${panel.top}V${panel.top + panel.h}` }));
    others.forEach((name, k) => {
      const [g, r] = values[k], same = like(name), c = same ? 1 : 0;
      panel.inside.append(sv("path", { class: `line l${c}`, d: `M${panel.X(g - r)} ${panel.Y(k)}H${panel.X(g + r)}` }),
        sv("circle", { class: `dot f${c}`, cx: panel.X(g), cy: panel.Y(k), r: 4.5 }, sv("title", null, `${name}: ${short(g)} \u00b1 ${short(r)}`)));
    });
    const same = others.filter(like);
    at("differences").append(el("p", { class: "quiet", id: "told-apart" }, same.length ? `Cannot be told from ${state.one} (Holm; dashed orange): ${same.join(", ")}.` : `All others can be told from ${state.one}.`));
  }

  function all() {
    const { names } = data.compared[state.kind];
    if (!names.includes(state.one)) state.one = names[0] || null;
    controls.replaceChildren(choice("Balanced accuracy", kinds, state.kind, (value) => { state.kind = value; all(); }),
      choice("Compare with", names.map((name) => [name, name]), state.one, (value) => { state.one = value; draw(); }));
    draw();
  }
  function draw() { ranking(); differences(); }
  all();
  return draw;
}
