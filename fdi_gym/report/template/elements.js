// Elements, numbers and downloads of nothing: texts are set as text, never as markup.
const data = JSON.parse(document.getElementById("data").textContent);
const SVG = "http://www.w3.org/2000/svg";
const at = (id) => document.getElementById(id);

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) node.setAttribute(name, value);
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}
const el = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
const sv = (tag, attributes, ...children) => fill(document.createElementNS(SVG, tag), attributes, children);

const short = (v, digits = 3) => v === null || Number.isNaN(v) ? "-" : String(Number(v.toPrecision(digits))).replace("-", "\u2212");
const percent = (v) => v === null ? "-" : (100 * v).toFixed(1);
const starred = (method) => method.name + (method.knows ? " *" : "");
const broken = (name) => name.split(/(?<=[_:.])/).flatMap((part) => [part, el("wbr")]); // a long name may end a line there
const byName = new Map(data.methods.map((method) => [method.name, method]));

function choice(label, options, value, changed) { // options: [value, text]
  const select = el("select", { onchange: () => changed(select.value) },
    ...options.map(([key, text]) => el("option", { value: key, selected: key === value }, text)));
  return el("label", null, label, select);
}

function several(legend, options, chosen, most, changed) { // checkboxes, at most so many at once; folded where they are many
  const summary = el("summary"), boxes = options.map(([key, text]) => el("input", { type: "checkbox", value: key, checked: chosen.includes(key), onchange: tell }));
  const title = () => `${legend}: ${boxes.filter((box) => box.checked).length} of ${boxes.length} shown` + (most < boxes.length ? ` (up to ${most})` : "");
  for (const box of boxes) box.disabled = !box.checked && chosen.length >= most;
  if (boxes.length <= 8) {
    return el("fieldset", null, el("legend", { class: "quiet" }, legend), ...boxes.map((box, i) => el("label", null, box, options[i][1])));
  }
  function tell() {
    if (boxes.length > 8) summary.textContent = title();
    const on = boxes.filter((box) => box.checked).map((box) => box.value);
    for (const box of boxes) box.disabled = !box.checked && on.length >= most;
    changed(on);
  }
  const all = el("fieldset", { "aria-label": legend }, ...boxes.map((box, i) => el("label", null, box, options[i][1])));
  summary.textContent = title();
  return el("details", null, summary, all);
}

function sample(i, kind = "line") { // a piece of the i-th line, for a legend
  const mark = { line: () => sv("path", { d: "M1 6H33", class: `line l${i}` }), truth: () => sv("path", { d: "M1 6H33", class: "truth" }),
    limit: () => sv("path", { d: "M1 6H33", class: "limit" }), shade: () => sv("rect", { x: 1, y: 1, width: 32, height: 10, class: "shade" }),
    block: () => sv("rect", { x: 1, y: 2, width: 32, height: 8, class: "block" }), heat: () => sv("rect", { x: 1, y: 2, width: 32, height: 8, class: "heat", opacity: .45 }),
    band: () => sv("rect", { x: 1, y: 1, width: 32, height: 10, class: `band f${i}` }) };
  return sv("svg", { viewBox: "0 0 34 12", "aria-hidden": "true" }, mark[kind]());
}
const legend = (...items) => items.map(([i, kind, text]) => el("span", null, sample(i, kind), text));
