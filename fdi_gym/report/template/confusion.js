// Confusion matrices as tables: rows are true, columns declared, in percent of the row; counts on demand.
function confusion() {
  const state = { name: (data.methods.find((m) => !m.ceiling && m.family !== "floor") || data.methods[0]).name, counts: false };
  const controls = at("confusion-controls");
  controls.append(choice("Method", data.methods.map((m) => [m.name, starred(m)]), state.name, (value) => { state.name = value; draw(); }),
    choice("Show", [["share", "percent of the true label"], ["counts", "counts"]], "share", (value) => { state.counts = value === "counts"; draw(); }));

  function matrix(kind) {
    const counts = byName.get(state.name).confusion[kind];
    const lost = counts.some((row) => row[row.length - 1] > 0), names = lost ? [...data.labels, "lost"] : data.labels;
    const many = data.labels.length > 8, titled = (name, j) => many && name !== "lost" ? `${j} ${name}` : name; // long names across are numbers
    const head = el("tr", null, el("td"), ...names.map((name, j) => el("th", { scope: "col", title: name, class: many ? "number" : null }, el("span", null, many && name !== "lost" ? String(j) : name))), el("th", { scope: "col" }, el("span", null, "n")));
    const body = data.labels.map((label, i) => {
      const total = counts[i].reduce((a, b) => a + b, 0);
      const cells = names.map((name, j) => {
        const share = total ? counts[i][j] / total : 0;
        const text = state.counts ? (counts[i][j] ? String(counts[i][j]) : "") : share >= 0.005 ? (100 * share).toFixed(0) : "";
        const cell = el("td", { class: i === j ? "right" : null, title: `true ${label}, declared ${name}: ${counts[i][j]} of ${total}` }, text);
        cell.style.backgroundColor = `rgba(var(--heat), ${(0.75 * share).toFixed(3)})`;
        return cell;
      });
      return el("tr", null, el("th", { scope: "row" }, titled(label, i)), ...cells, el("td", { class: "quiet" }, String(total)));
    });
    const asked = { per_sample: "samples", per_decision: "decisions" }[kind];
    return el("figure", null, el("figcaption", null, el("b", null, kind.replace("_", " ")), ` \u2013 true label down, declared across; n ${asked}`),
      el("div", { class: "wide", tabindex: 0, role: "region", "aria-label": `Confusion matrix ${kind.replace("_", " ")}` }, el("table", { class: many ? "matrix many" : "matrix" }, el("thead", null, head), el("tbody", null, ...body))));
  }
  at("matrices").classList.toggle("two", data.labels.length <= 8);
  function draw() { at("matrices").replaceChildren(matrix("per_sample"), matrix("per_decision")); }
  draw();
}
