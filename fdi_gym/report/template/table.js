// The table of methods: sorted by any column, filtered by name, by kind and by task.
function methodsTable() {
  const first = Object.keys(data.groups)[0];
  const state = { group: first, text: "", families: new Set(data.methods.map((m) => m.family)), column: null, down: true };
  const families = [...state.families].sort();
  const lower = new Set(["isolated", "alarms", "under", "begun", "missed", "detected", "error", "onset", "size", "time"]); // is better

  const search = el("input", { type: "search", id: "filter", placeholder: "name or words", oninput: () => { state.text = search.value; rows(); } });
  at("table-controls").append(
    el("label", null, "Filter", search),
    choice("Task", [...Object.keys(data.groups).map((name) => [name, name]), ["", "all"]], first, (value) => { state.group = value; state.column = null; all(); }),
    several("Kinds", families.map((name) => [name, name]), families, families.length, (on) => { state.families = new Set(on); rows(); }));

  const shown = () => data.columns.map((column, i) => ({ ...column, i })).filter((column) => !state.group || data.groups[state.group].includes(column.key));
  const number = (text) => { // what a reader sees is what is sorted
    if (text === "=") return 1;
    if (/^(huge|never)/.test(text)) return Infinity;
    const found = /-?\d+(\.\d+)?/.exec(text);
    return found ? Number(found[0]) : null;
  };

  function rows() {
    const words = state.text.toLowerCase().split(/\s+/).filter(Boolean);
    let found = data.methods.filter((m) => state.families.has(m.family) && words.every((w) => `${m.name} ${m.summary}`.toLowerCase().includes(w)));
    if (state.column === "name") found = [...found].sort((a, b) => (state.down ? 1 : -1) * (a.name < b.name ? -1 : a.name > b.name ? 1 : 0));
    else if (state.column !== null) {
      const i = data.columns.findIndex((column) => column.key === state.column);
      const value = (m) => number(m.cells[i]);
      found = [...found].sort((a, b) => {
        const [x, y] = [value(a), value(b)];
        if (x === null || y === null) return (x === null) - (y === null); // what has no figure is last, either way
        return x === y ? 0 : (state.down ? -1 : 1) * (x < y ? -1 : 1);
      });
    }
    const body = found.map((m) => el("tr", { class: m.family === "floor" || m.ceiling ? "frame" : null, "data-name": m.name },
      el("td", { title: m.summary }, ...broken(starred(m)), m.lost ? ` (${m.lost} lost)` : ""), ...shown().map((column) => el("td", null, m.cells[column.i]))));
    at("table").tBodies[0].replaceChildren(...body);
    const told = found.filter((m) => m.knows).map((m) => `${m.name} knows ${m.knows}${m.ceiling ? "" : "; no ceiling"}.`);
    at("table-notes").textContent = [`${found.length} of ${data.methods.length} methods.`, ...told.map((t) => `* ${t}`)].join(" ");
  }

  function all() {
    const heads = [{ key: "name", head: "method" }, ...shown()].map((column) => {
      const sort = state.column !== column.key ? "none" : state.down === (column.key !== "name") ? "descending" : "ascending";
      const pressed = () => {
        state.down = state.column === column.key ? !state.down : !lower.has(column.key);
        state.column = column.key;
        all();
        at("table").querySelector(`[data-key="${column.key}"]`).focus();
      };
      return el("th", { scope: "col", "aria-sort": sort }, el("button", { type: "button", "data-key": column.key, onclick: pressed }, column.head));
    });
    at("table").replaceChildren(el("thead", null, el("tr", null, ...heads)), el("tbody"));
    rows();
  }
  all();
}
